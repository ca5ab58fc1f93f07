"""A scene's XML is read within bounds: what is refused here has crashed, hung or filled the memory before."""

import time

import pytest

from envedit.core.errors import InputError
from envedit.scene import scene, scene_text
from tests.oracles.builders import BALL, LIGHT, SENSOR, write_scene


def refused(path, says, **parameters):
    """Check that a scene is refused soon, with these words on one line."""
    begun = time.perf_counter()
    with pytest.raises(InputError, match=says) as caught:
        scene.load(path, parameters=parameters or None)
    assert time.perf_counter() - begun < 5
    message = str(caught.value)
    assert len(message.splitlines()) == 1 and len(message) < 600
    return message


@pytest.mark.parametrize("depth", [scene_text.DEEPEST + 1, 3_000, 20_000])
def test_deeply_nested_elements_are_refused(tmp_path, depth):
    nested = '<bsdf type="twosided">' * depth + "</bsdf>" * depth
    refused(write_scene(tmp_path, SENSOR, LIGHT, nested), r"line \d+: more than 20 elements inside")


@pytest.mark.slow
def test_a_long_chain_of_references_is_refused_and_a_short_one_is_not(tmp_path):
    def chain(length):
        parts = [f'<bsdf type="twosided" id="b{i}"><ref id="b{i + 1}"/></bsdf>' for i in range(length)]
        return write_scene(tmp_path, SENSOR, LIGHT, *parts, f'<bsdf type="diffuse" id="b{length}"/>')

    refused(chain(20_000), "more than 20 deep")
    assert scene.load(chain(10)).mi.shapes() == []


def test_references_in_a_circle_are_refused(tmp_path):
    parts = [f'<bsdf type="twosided" id="{one}"><ref id="{other}"/></bsdf>' for one, other in ("ab", "ba")]
    refused(write_scene(tmp_path, SENSOR, LIGHT, *parts), "refer to one another in a circle")


@pytest.mark.parametrize("part, says", [
    ('<bsdf type="blendbsdf"/>', "blendbsdf has no weight"),
    ('<bsdf type="BlendBSDF" id="b"><bsdf type="diffuse"/></bsdf>', "blendbsdf has no weight"),
    ('<bsdf type="normalmap"><bsdf type="diffuse"/></bsdf>', "normalmap has no normalmap"),
    ('<emitter type="spot"><texture name="texture" type="bitmap"/></emitter>', "bitmap has no filename"),
    ('<texture type="bitmap"><float name="filename" value="2"/></texture>', "filename is 2"),
])  # fmt: skip
def test_what_mitsuba_reads_without_looking_must_be_there(tmp_path, part, says):
    refused(write_scene(tmp_path, SENSOR, LIGHT, part), says)


@pytest.mark.parametrize("name", ["test.xml", "x/../test.xml", "./x/.././x/../test.xml"])
def test_an_include_of_itself_is_refused(tmp_path, name):
    (tmp_path / "x").mkdir()
    path = write_scene(tmp_path, SENSOR, LIGHT, f'<include filename="{name}"/>')
    refused(path, r"test\.xml, .*more than 15 deep; does a file include itself\?")


def test_includes_that_double_are_refused(tmp_path):
    for i in range(13):
        twice = f'<include filename="{i + 1}.xml"/>' * 2
        write_scene(tmp_path, twice, name=f"{i}.xml")
    write_scene(tmp_path, BALL, name="13.xml")
    refused(tmp_path / "0.xml", "includes and fills in has more than 64 MB")


def test_defaults_that_expand_into_each_other_are_refused(tmp_path):
    first = '<default name="a0" value="0123456789"/>'
    doubled = [f'<default name="a{i + 1}" value="$a{i}$a{i}"/>' for i in range(30)]
    refused(write_scene(tmp_path, first, *doubled, SENSOR, LIGHT), r"line \d+: .*more than 64 MB")
    # The same at the place of use: longer names are filled in first, and what they hold after them.
    held = [("\\$" + "a" * (29 - i)) * 2 for i in range(29)] + ["x"]
    grown = [f'<default name="{"a" * (30 - i)}" value="{text}"/>' for i, text in enumerate(held)]
    use = f'<string name="s" value="${"a" * 30}"/>'
    refused(write_scene(tmp_path, *grown, SENSOR, LIGHT, use), "more than 64 MB")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("<!--" * 40_000, "Error parsing comment"),
        ("<![CDATA[" * 20_000, "Error parsing CDATA section"),
        ('<a b="' * 40_000, "line 1: a tag is not well formed"),
        ("<" * 160_000, "line 1: a tag is not well formed"),
        ("<a " + "b " * 80_000, "line 1: a tag is not well formed"),
        ('<!DOCTYPE scene [<!ENTITY a "b">]>', "a DOCTYPE is not read"),
        ("root:x:0:0:root:/root:/bin/bash", "is no XML file"),
        ("\ufeff<\0s\0", "is no XML file in UTF-8"),
        ("", "is no XML file"),
    ],
    ids=["comments", "cdata", "quotes", "brackets", "attributes", "doctype", "passwd", "utf-16", "empty"],
)
def test_what_is_no_xml_is_told_soon_and_without_its_text(tmp_path, text, says):
    (tmp_path / "test.xml").write_text(text)
    assert "root:" not in refused(tmp_path / "test.xml", says)
    included = write_scene(tmp_path, SENSOR, LIGHT, '<include filename="test.xml"/>', name="outer.xml")
    message = refused(included, says)
    assert "root:" not in message and str(tmp_path / "test.xml") in message
    assert str(included) in message or says != "is no XML file"


def test_sizes_are_bounded(tmp_path, monkeypatch):
    path = tmp_path / "test.xml"
    path.write_text("<scene>")
    with open(path, "r+b") as file:
        file.truncate(scene_text.MOST_CHARACTERS + 1)  # sparse
    refused(path, "more than 64 MB")
    monkeypatch.setattr(scene_text, "MOST_CHARACTERS", 2**18)  # for short tests
    refused(write_scene(tmp_path, *["<integer/>"] * 5_000), "more than")
    refused(write_scene(tmp_path, *[f'<default name="a{i}" value=""/>' for i in range(4)]), "more than")
    refused(write_scene(tmp_path, *['<path value="."/>'] * 4), "more than")


def test_other_letters_than_utf_8_are_refused_in_tags_alone(tmp_path):
    path = write_scene(tmp_path, SENSOR, LIGHT, "<!-- by Mu -->", BALL)
    latin = path.read_bytes().replace(b"Mu", b"M\xfc")
    path.write_bytes(latin)
    scene_text.read(path, {})
    path.write_bytes(latin.replace(b'"sphere"', b'"sph\xe8re"'))
    refused(path, r"line \d+: a tag is not in UTF-8")


def test_what_mitsuba_reads_is_read_alike(tmp_path):
    (tmp_path / "parts").mkdir()
    write_scene(tmp_path / "parts", BALL.replace("0.2, 0.4, 0.6", "$albedo"), name="ball.xml")
    write_scene(tmp_path / "parts", '<include filename="ball.xml"/>', name="both.xml")
    body = (
        '<?xml version="1.0"?><!-- a -- b > c <shape type="none"> --><default name="name" value="bo"/>'
        "<default name='albedo' value='0.&#53;'/><path value=\"parts\"/>"
        "<include filename='$name&#116;h.xml'/>"
        '<default name="note" value="a > b, \\$albedo"/>'
    )
    (tmp_path / "test.xml").write_text(f'<scene version="3.0.0">{body}{SENSOR}{LIGHT}</scene>')
    found = scene_text.read(tmp_path / "test.xml", {})
    assert found.defaults == {"name", "albedo", "note"} and found.used >= {"name", "albedo"}
    assert [str(f) for f in found.folders] == [str(tmp_path / "parts")]
    assert len(scene.load(tmp_path / "test.xml").mi.shapes()) == 1
