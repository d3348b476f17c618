"""The page of the diagnosis' numbers, and that each number says what it is."""

from pathlib import Path

from tools.numbers import PAGE, ROOMS, ROOT, Number, numbers, page


def test_every_number_says_what_it_is():
    silent = [
        f"{file.relative_to(ROOT)}: {', '.join(one.names)}"
        for room in ROOMS
        for file in sorted((ROOT / room).rglob("*.py"))
        for one in numbers(file.read_text("utf-8"))
        if not one.said
    ]
    assert silent == []


def test_the_page_is_that_of_the_source():
    assert Path(PAGE).read_text("utf-8") == page(), "python -m tools.numbers writes it anew"


def test_a_comment_is_found_beside_a_number_or_right_above_it():
    text = "# Above,\n# in two.\nA = 3\n\nB, C = 1, 2.5  # beside\nD = 'x'\nE = 4\nlower = 1\n"
    assert list(numbers(text)) == [
        Number(("A",), "3", "Above, in two."),
        Number(("B", "C"), "(1, 2.5)", "beside"),
        Number(("E",), "4", ""),
    ]
