"""Models made to cost time or memory are refused before MuJoCo reads them."""

from __future__ import annotations

import struct
import time
import zlib
from pathlib import Path

import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.limits import limit
from amhe_cli.system.model.files import compiled, read_spec


def png(path: Path, width: int, height: int) -> Path:
    """A black picture, a byte for each eight pixels before it is packed."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head, rows = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0), bytes((1 + (width + 7) // 8) * height)
    parts = (b"IHDR", head), (b"IDAT", zlib.compress(rows, 1)), (b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(kind, data) for kind, data in parts))
    return path


def refused(path: Path, inner: str) -> str:
    path.write_text(f"<mujoco>{inner}<worldbody><geom size='.1'/></worldbody></mujoco>")
    begun = time.process_time()
    with pytest.raises(ConfigError) as error:
        read_spec(path)
    assert time.process_time() - begun < 5.0
    assert "\n" not in str(error.value)
    return str(error.value)


TEXTURE = "<asset><texture name='a' type='2d' file='a.png'/></asset>"


@pytest.mark.parametrize(
    "inner",
    [
        TEXTURE,
        "<asset><texture name='a' type='cube' fileright='a.png'/></asset>",
        "<compiler texturedir='in'/><asset><texture name='a' type='2d' file='b.png'/></asset>",
        "<asset><hfield name='h' file='a.png' size='1 1 1 1'/></asset>",
    ],
)
def test_an_image_that_unfolds_to_too_much(inner: str, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for name in ("a.png", "in/b.png"):
        png(tmp_path / name, 8000, 8000)
    assert "64000000 pixels of its images are beyond the limit model_numbers" in refused(
        tmp_path / "m.xml", inner
    )


def test_usual_images_are_read(tmp_path: Path) -> None:
    png(tmp_path / "a.png", 64, 64)
    (tmp_path / "m.xml").write_text(f"<mujoco>{TEXTURE}<worldbody><geom size='.1'/></worldbody></mujoco>")
    assert compiled(read_spec(tmp_path / "m.xml")).ntex == 1


@pytest.mark.parametrize(
    ("inner", "name"),
    [
        ("<option iterations='1000000000' tolerance='0'/>", "model_iterations"),
        ("<option iterations='10000' ls_iterations='1e4'/>", "model_iterations"),
        ("<option noslip_iterations='2000000'/>", "model_iterations"),
        ("<keyframe>" + "<key/>" * 90_000 + "</keyframe>", "model_elements"),
        ("<worldbody>" + "<body><geom size='.1'/></body>" * 3_000 + "</worldbody>", "model_elements"),
        ("<custom><numeric name='n' size='1000000000'/></custom>", "model_numbers"),
        ("<size nuser_geom='900000'/>" + "<worldbody><geom size='.1'/></worldbody>" * 50, "model_numbers"),
        (
            "<asset>" + "<hfield name='h' nrow='4000' ncol='4000' size='1 1 1 1'/>" * 4 + "</asset>",
            "model_numbers",
        ),
        ("<asset><mesh name='a' builtin='supersphere' params='100000 1 1'/></asset>", "model_numbers"),
        ("<sensor><user dim='100000000'/></sensor>", "model_numbers"),
        ("<!--" + "x" * 2**21 + "-->", "model_mib"),
    ],
)
def test_a_number_that_asks_for_too_much(inner: str, name: str, tmp_path: Path) -> None:
    with limit(model_mib=1 if name == "model_mib" else 64):
        assert f"beyond the limit {name} = " in refused(tmp_path / "m.xml", inner)


def test_models_that_are_attached_count_each_time(tmp_path: Path) -> None:
    geoms = "<geom size='.1'/>" * 100
    (tmp_path / "c.xml").write_text(f"<mujoco><worldbody><body name='x'>{geoms}</body></worldbody></mujoco>")
    attach = "".join(f"<attach model='c' body='x' prefix='{i}'/>" for i in range(20))
    middle = (
        f"<asset><model name='c' file='c.xml'/></asset><worldbody><body name='x'>{attach}</body></worldbody>"
    )
    (tmp_path / "b.xml").write_text(f"<mujoco>{middle}</mujoco>")
    attach = attach.replace("'c'", "'b'")
    whole = f"<asset><model name='b' file='b.xml'/></asset><worldbody><body>{attach}</body></worldbody>"
    assert "beyond the limit model_elements" in refused(tmp_path / "m.xml", whole)
    assert len(read_spec(tmp_path / "b.xml").geoms) == 2000


def test_what_only_mujoco_reads_is_refused(tmp_path: Path) -> None:
    """Its parser takes attributes twice and entities that are none; the look before would be blind."""
    text = refused(tmp_path / "m.xml", "<option timestep='0.01'timestep='0.02'/>")
    assert "no well-formed XML" in text and "line 1" in text
