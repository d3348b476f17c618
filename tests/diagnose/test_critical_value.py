"""Chi-square that an effect must explain: noise reaches it in the best of a table two times in a
thousand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from samii_rig.diagnose.fit.record_search import ALARM, RecordSearch


def searched(others: list[int], lines: int, resonant: int = 3) -> RecordSearch:
    """A search with a table of effects of so many unknowns each, and some that resonate."""
    search = object.__new__(RecordSearch)
    plain = [SimpleNamespace(physics="added_mass", unknowns=(0,) * n) for n in others]
    hung = [SimpleNamespace(physics="attached_oscillator", unknowns=(0,) * 3)] * resonant
    search.table = (*plain, *hung)  # type: ignore[assignment]
    search.whole = SimpleNamespace(lines=lines)  # type: ignore[assignment]
    return search


@pytest.mark.parametrize(("others", "lines"), [([1] * 90 + [2] * 60, 1500), ([1] * 4, 40_000)])
def test_noise_passes_for_any_effect_as_rarely_as_is_said(others: list[int], lines: int) -> None:
    search = searched(others, lines)
    plain, hung = search.table[0], search.table[-1]
    none = np.prod(1 - stats.chi2.sf(search.critical_value_of((plain,)), others))
    none *= (1 - stats.chi2.sf(search.critical_value_of((hung,)), 2)) ** (2 * lines)
    assert 1 - none == pytest.approx(ALARM, rel=2e-3)


def test_what_does_not_resonate_does_not_pay_for_the_lines() -> None:
    few, many = searched([1] * 90, 1000), searched([1] * 90, 10_000)
    plain, hung = few.table[0], few.table[-1]
    assert many.critical_value_of((plain,)) == few.critical_value == many.critical_value
    # Ten times as many tries: a chance of a tenth each, of two unknowns exp(-t/2).
    more = many.critical_value_of((plain, hung)) - few.critical_value_of((hung,))
    assert more == pytest.approx(2 * np.log(10))


def test_a_table_of_what_resonates_alone_has_a_critical_value() -> None:
    search = searched([], 1000)
    assert search.critical_value == pytest.approx(float(stats.chi2.isf(ALARM / 2, 1)))
