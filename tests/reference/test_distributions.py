"""The reference program's histograms of scattered directions against our laws, with its faults and without."""

import pytest

from benchmarks.reference_counts import SETS, WRONG_THERE, law_p_value


@pytest.mark.parametrize("name", SETS)
def test_compatible_laws(shared, name):
    """Every set is matched with the program's faults switched on (p > 1e-4); catches a fault copied wrongly."""
    p = law_p_value(shared, name, "shem-ray-tracing")
    print(f"{name}: p = {p:.3g}")
    assert p > 1e-4, f"{name}: p = {p:.2e}"


@pytest.mark.parametrize("name", WRONG_THERE)
def test_correct_laws_differ(shared, name):
    """The same test rejects the correct laws, where the program's are wrong (thermal: few are left)."""
    assert law_p_value(shared, name, "none") < 1e-9
