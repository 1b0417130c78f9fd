"""Download the paper's public micrographs. The only import of pooch. The files stay outside the repository.

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
    "albedo_sphereA.mat": "4d8cf9b86986c62480df559df50d411c7f5e48f109871e0a3aa97736127c1669",
    "sc100351.mat": "d57c87e933f0d8b01d05823718a576b73637f3fe5082cad226a593d32e1e4f0f",
    "sc100378.mat": "8c34d7d6d3b969f37dd54c5c7842c2af22eac1953ed375609831fbe821f09c62",
    "scan003248.mat": "e638cde6d11131d8c4ac6ff314bc73320aa253199fbe94b8bf055b18843e70d7",
    "scan003250.mat": "918d2632b0516029caf5ab8ddfaf38d1f5618bd6332576f4eefc214bd034cabf",
    "scan003259.mat": "8cdd7918fcd1376003d9780aacd4f05d3c85214436c6fd30b5e790a9e0b79133",
    "scan003260.mat": "7dfd1f2cf2c75e79d619b197eda6662d4ee5ad6989dc0548815adb41625f180e",
    "scan003262.mat": "7a3df66c04b36b3393b57fe5995a719cdca18df773383ccd797b7d2705827d61",
    "sphereA_sc100351_reconstruction.mat": "8f4f19f110202f1389f9c379281fa3cf30c731fd11851636cb0c5668c1d8e062",
    "sphere_a_simulated.mat": "055585371c5b5f2cb6fd658b8a201713cf6aadc0d4ff3b8c7b67d3c4efdaba74",
    "sphere_a_simulated_parameters.txt": "cc884b45efa1fabb1f02eec902e263663cc7cb4e104385fe73425308122d62c7",
}
"""SHA-256 of every file, by its local name."""
_SIMULATION = "simulations/0026_sphere_A_final_final_simulation/"
_PATHS = {
    "sphere_a_simulated.mat": _SIMULATION + "formatted/reconstructionSimulation.mat",
    "sphere_a_simulated_parameters.txt": _SIMULATION + "ray_tracing_parameters.txt",
}
"""Path in the pack of files that are not at datafiles/NAME."""


def fetch_pack(folder: Path | None = None) -> list[Path]:
    """Download missing files and check the SHA-256 of all.

    Args:
        folder: target; default: the user's cache.

    Raises:
        InputFileError: a file cannot be downloaded, or its SHA-256 differs.
    """
    import pooch

    where = Path(folder) if folder else Path(pooch.os_cache("helio_jax"))
    out = []
    for name, digest in FILES.items():
        url = SOURCE + _PATHS.get(name, f"datafiles/{name}")
        try:
            out.append(Path(pooch.retrieve(url, f"sha256:{digest}", fname=name, path=where / "data")))
        except Exception as e:
            raise InputFileError(
                f"{name}: cannot be fetched from the data pack ({e}); check the network, or copy the file "
                f"to {where / 'data'}"
            ) from None
    return out
