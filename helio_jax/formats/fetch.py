"""Download the paper's public micrographs; the only door to pooch. The files stay outside the repository.

S. Lambrick, A. Radic, C. Zhao, "heliometric-stereo-data-pack", licence CC BY-SA, doi 10.5281/zenodo.15548542.
"""

from pathlib import Path

from helio_jax.errors import InputFileError

COMMIT = "f1978fbc0ed6def8adf1a982b13f8609c37e966e"
SOURCE = f"https://raw.githubusercontent.com/slambrick/heliometric-stereo-data-pack/{COMMIT}/"
CITATION = (
    "Data: S. Lambrick, A. Radic, C. Zhao, heliometric-stereo-data-pack, doi 10.5281/zenodo.15548542, CC BY-SA; "
    "please cite it and arXiv:2501.14833."
)
FILES = {
    "albedo_sphereA.mat": (
        "datafiles/albedo_sphereA.mat",
        "4d8cf9b86986c62480df559df50d411c7f5e48f109871e0a3aa97736127c1669",
    ),
    "sc100351.mat": (
        "datafiles/sc100351.mat",
        "d57c87e933f0d8b01d05823718a576b73637f3fe5082cad226a593d32e1e4f0f",
    ),
    "sc100378.mat": (
        "datafiles/sc100378.mat",
        "8c34d7d6d3b969f37dd54c5c7842c2af22eac1953ed375609831fbe821f09c62",
    ),
    "scan003248.mat": (
        "datafiles/scan003248.mat",
        "e638cde6d11131d8c4ac6ff314bc73320aa253199fbe94b8bf055b18843e70d7",
    ),
    "scan003250.mat": (
        "datafiles/scan003250.mat",
        "918d2632b0516029caf5ab8ddfaf38d1f5618bd6332576f4eefc214bd034cabf",
    ),
    "scan003259.mat": (
        "datafiles/scan003259.mat",
        "8cdd7918fcd1376003d9780aacd4f05d3c85214436c6fd30b5e790a9e0b79133",
    ),
    "scan003260.mat": (
        "datafiles/scan003260.mat",
        "7dfd1f2cf2c75e79d619b197eda6662d4ee5ad6989dc0548815adb41625f180e",
    ),
    "scan003262.mat": (
        "datafiles/scan003262.mat",
        "7a3df66c04b36b3393b57fe5995a719cdca18df773383ccd797b7d2705827d61",
    ),
    "sphereA_sc100351_reconstruction.mat": (
        "datafiles/sphereA_sc100351_reconstruction.mat",
        "8f4f19f110202f1389f9c379281fa3cf30c731fd11851636cb0c5668c1d8e062",
    ),
    "sphere_a_simulated.mat": (
        "simulations/0026_sphere_A_final_final_simulation/formatted/reconstructionSimulation.mat",
        "055585371c5b5f2cb6fd658b8a201713cf6aadc0d4ff3b8c7b67d3c4efdaba74",
    ),
    "sphere_a_simulated_parameters.txt": (
        "simulations/0026_sphere_A_final_final_simulation/ray_tracing_parameters.txt",
        "cc884b45efa1fabb1f02eec902e263663cc7cb4e104385fe73425308122d62c7",
    ),
}
"""Local name: (path in the pack, SHA-256)."""


def fetch_pack(folder: Path | None = None) -> list[Path]:
    """Download every file that is not there yet and check its SHA-256.

    Args:
        folder: where they go; default: the user's cache.

    Raises:
        InputFileError: a file cannot be downloaded, or is not the expected one.
    """
    import pooch

    where = Path(folder) if folder else Path(pooch.os_cache("helio_jax"))
    out = []
    for name, (place, digest) in FILES.items():
        try:
            out.append(Path(pooch.retrieve(SOURCE + place, f"sha256:{digest}", fname=name, path=where / "data")))
        except Exception as e:
            raise InputFileError(
                f"{name}: could not be fetched from the data pack ({e}); check the network, or put the file by hand "
                f"into {where / 'data'}"
            ) from None
    return out
