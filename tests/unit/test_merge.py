"""Lists of a file that extends another: replaced, added to, and what is said about it."""

import pytest

from helio_jax.errors import SceneError
from helio_jax.workflows.merge import append, merge
from helio_jax.workflows.scene_file import load_instrument, load_scene, replaced_lists

BASE = {"detector": [{"name": "a"}, {"name": "b"}], "sample": {"kind": "spheres", "spheres": [{"r": 1}]}, "n": 3}
FOURTH = '[[append.detector]]\nname = "above"\npolar_deg = 5.0\nhalf_angle_deg = 4.0\n'
SAMPLE = '[sample]\nkind = "flat"\n[scan]\nnx = 3\nny = 3\npixel_size_um = 9.0\n'


def test_lists_that_are_replaced():
    """Lists of tables are listed with their path, before and after; lists of numbers, other kinds, indices are not.

    Catches a silent replacement of the inherited detectors, and a word about every list of two numbers.
    """
    replaced = []
    over = {"detector": [{"name": "c"}], "sample": {"spheres": [{"r": 2}, {"r": 3}]}, "n": 4}
    assert merge(BASE, over, replaced)["detector"] == [{"name": "c"}]
    assert replaced == [("detector", 2, 1), ("sample.spheres", 1, 2)]
    replaced.clear()
    merge(BASE, {"sample": {"kind": "mesh"}, "detector": {"0": {"name": "z"}}}, replaced)
    merge({"center_um": [1, 2]}, {"center_um": [3, 4]}, replaced)
    assert replaced == []


def test_append():
    """Catches an addition in front, one that changes the base, and a table that is lost beside it."""
    more = {"detector": [{"name": "c"}], "sample": {"spheres": [{"r": 2}]}}
    found = append(BASE, more)
    assert [d["name"] for d in found["detector"]] == ["a", "b", "c"] and found["n"] == 3
    assert found["sample"] == {"kind": "spheres", "spheres": [{"r": 1}, {"r": 2}]}
    assert len(BASE["detector"]) == 2


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (3, "must be a table of lists, got 3"),
        ({"detectr": [1]}, "append.detectr: the extended file has no such list"),
        ({"sample": {"parts": [1]}}, r"append.sample.parts: the extended file has no such list: add with"),
        ({"detector": {"name": "c"}}, "append.detector: must be a list"),
        ({"n": [4]}, "append.n: n is no list"),
    ],
)
def test_append_refuses(more, told):
    """Catches a misspelt list that is begun silently, and a single table that replaces a list."""
    with pytest.raises(SceneError, match=told):
        append(BASE, more)


def test_files(tmp_path):
    """A fourth detector is added to a shipped instrument; a file that replaces them says so, in errors, too.

    Catches [[append]] that is taken for an unknown table, one without extends, and an error that hides the cause.
    """
    path = tmp_path / "i.toml"
    path.write_text(f'extends = "bshem_wd4"\n{FOURTH}')
    assert load_instrument(path).detector_names == ("forward", "right", "left", "above")
    assert replaced_lists(path) == []
    path.write_text('extends = "bshem_wd4"\ndetector.1.name = "other"\n')
    assert load_instrument(path).detector_names == ("forward", "other", "left")
    path.write_text(FOURTH)
    with pytest.raises(SceneError, match=r"i\.toml: append adds to the lists of another file: name it with extends"):
        load_instrument(path)
    path.write_text(f'extends = "bshem_wd4"\n{FOURTH}'.replace("append.detector", "append.detectors"))
    with pytest.raises(SceneError, match=r"i\.toml: append\.detectors: the extended file has no such list"):
        load_instrument(path)
    path.write_text(f'extends = "bshem_wd4"\nnoise.gain = [1, 1, 1]\n{SAMPLE}{FOURTH}'.replace("append.", ""))
    (note,) = replaced_lists(path)
    assert note.startswith("[[detector]] (1 here) replaces all 3 of") and "write [[append.detector]]" in note
    with pytest.raises(SceneError) as error:
        load_scene(path)
    assert "one per detector (1), got 3" in str(error.value) and note in str(error.value)
