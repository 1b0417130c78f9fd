"""Predictions of masks and multiple scattering for tests that trace nothing."""

from helio_jax.forward.render import Corrections


def nothing_traced(height, normals, *_, **__) -> Corrections:
    """Predict for three detectors no masks and no multiple scattering."""
    return Corrections.none((3, *height.shape))
