"""What the derivative tests share."""

import pytest

from helio_jax.forward.optics import Optics
from helio_jax.instrument import Beam, Detector, Instrument, Plate


@pytest.fixture(scope="module")
def oblique() -> Instrument:
    """Make an instrument with an oblique beam along an odd azimuth and two rotated ellipses."""
    ellipses = (((2300.0, 100.0), 20.0), ((-1100.0, 2000.0), -40.0))
    detectors = tuple(
        Detector(name=f"{i}", center_um=center, axes_um=(1300.0, 900.0), rotation_deg=turn)
        for i, (center, turn) in enumerate(ellipses)
    )
    plate = Plate(working_distance_um=4000.0, sample_distance_um=4400.0)
    return Instrument(beam=Beam(incidence_deg=25.0, azimuth_deg=35.0), plate=plate, detector=detectors)


@pytest.fixture(scope="module")
def optics(oblique) -> Optics:
    """Its optics."""
    return Optics.of(oblique)
