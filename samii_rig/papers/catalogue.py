"""All results of the papers, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, cast

from samii_rig.errors import InputError, one_of

if TYPE_CHECKING:
    from samii_rig.papers.result import Agreement, Result


@dataclass(frozen=True, slots=True)
class Entry:
    """One result. where : in the papers. function : `module:name` in this package.
    agreement : what its numbers show beside published ones, where they say nothing else.
    records : whether it drives the simulated rig first, which takes longer."""

    id: str
    where: str
    title: str
    function: str
    agreement: Agreement
    records: bool = False

    def compute(self) -> Result:
        """The result."""
        module, _, name = self.function.partition(":")
        made = cast("Callable[[], Result]", getattr(import_module(f"{__package__}.{module}"), name))
        return made().of_kind(self.agreement)


ENTRIES: tuple[Entry, ...] = (
    Entry(
        "table-1",
        "paper 1, Table I",
        "natural frequencies, perfect joints",
        "tables:table_1",
        "calibrated",
    ),
    Entry(
        "table-2",
        "paper 1, Table II",
        "the four stiffnesses from a recording",
        "identification:table_2",
        "found again",
        True,
    ),
    Entry(
        "table-3",
        "paper 1, Table III",
        "natural frequencies, flexible joints",
        "tables:table_3",
        "computed",
    ),
    Entry(
        "fig-3",
        "paper 1, Fig. 3; paper 2, Fig. 3, eq. 1, 2",
        "a perfect source misses mode 2",
        "spring_damper:figure_3",
        "found again",
        True,
    ),
    Entry(
        "p1-section-4a",
        "paper 1, section IV-A",
        "g_v changes damping, not frequencies",
        "velocity_feedback:section_4a",
        "computed",
    ),
    Entry(
        "limits",
        "paper 1, section IV-A; paper 2, section 4",
        "g_v and k to infinity",
        "velocity_feedback:limits",
        "computed",
    ),
    Entry(
        "method-1",
        "paper 1, section IV-C",
        "three numbers for four stiffnesses",
        "identification:method_1_result",
        "found again",
    ),
    Entry(
        "stage-2",
        "paper 1, section IV-C, step 2",
        "g_v from the amplitudes",
        "identification:stage_2",
        "found again",
        True,
    ),
    Entry(
        "method-2",
        "paper 1, section IV-D, eq. 19",
        "braced base",
        "identification:method_2_result",
        "found again",
        True,
    ),
    Entry(
        "encoder",
        "paper 1, section IV-B, C",
        "non-collocated encoder",
        "identification:encoder",
        "found again",
        True,
    ),
    Entry(
        "p1-fig-5", "paper 1, Fig. 5", "v_2 to theta_2", "overlays:figure_5", "found again", True
    ),
    Entry(
        "p1-fig-6",
        "paper 1, Fig. 6",
        "theta_2 to a_0 and its first zero",
        "overlays:figure_6",
        "computed",
        True,
    ),
    Entry(
        "p1-joint-3",
        "paper 1, section IV-C",
        "v_3 to theta_3",
        "overlays:joint_3",
        "found again",
        True,
    ),
    Entry(
        "p1-fig-8-9",
        "paper 1, Fig. 8 and 9",
        "mode shapes 1 and 2",
        "shapes:figures_8_9",
        "computed",
        True,
    ),
    Entry("p1-offset", "paper 1, Fig. 8", "the offset of mode 1", "shapes:offset", "computed"),
    Entry(
        "p1-section-5",
        "paper 1, section V",
        "generality and effort",
        "effort:section_5",
        "computed",
    ),
    Entry(
        "p2-fig-5",
        "paper 2, Fig. 5",
        "velocity feedback: dip, then rise",
        "velocity_feedback:figure_5",
        "calibrated",
    ),
    Entry(
        "p2-fig-8-10",
        "paper 2, Fig. 8 to 10",
        "torque test, vertical and horizontal",
        "torque:figures_8_9_10",
        "computed",
        True,
    ),
    Entry(
        "p2-fig-12",
        "paper 2, Fig. 12",
        "source with spring-damper: dip, recovery",
        "spring_damper:figure_12",
        "computed",
        True,
    ),
)


def entries(ids: list[str]) -> tuple[Entry, ...]:
    """The entries called `ids`, all without; InputError for one that there is not."""
    known = {e.id: e for e in ENTRIES}
    for name in ids:
        if name not in known:
            raise InputError("samii-rig papers", "ID", name, one_of(name, known))
    return tuple(known[name] for name in ids) if ids else ENTRIES
