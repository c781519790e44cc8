"""`r2p msg`: message types, and C headers that a compiler checks."""

from __future__ import annotations

import json
import shutil
import subprocess
from typing import TYPE_CHECKING, Annotated

import pytest
from typer.testing import CliRunner, Result

import r2p
from r2p.messages import Array, Len, Message, Timestamp, f32, f64, i8, i64, layout, u8, u16
from r2p.msg import Led, PointField
from r2p.tools.c_header import c_header
from r2p.tools.main import app
from r2p.tools.types import standard_types

if TYPE_CHECKING:
    from pathlib import Path

COMPILERS = [path for path in map(shutil.which, ("cc", "c++")) if path is not None]


class Cell(Message):
    """A part of Grid, and the end of a comment: */ here."""

    temperature: f64 = 0.0
    default: u8 = 0
    class_: i8 = 0


class Grid(Message, name="robot/Grid"):
    at: Timestamp = Timestamp()
    cells: tuple[tuple[Cell, Cell], tuple[Cell, Cell], tuple[Cell, Cell]] = ((Cell(),) * 2,) * 3
    names: tuple[Annotated[str, Len(5)], Annotated[str, Len(5)]] = ("", "")
    raw: Annotated[bytes, Len(7)] = bytes(7)
    ranges: Annotated[Array[f32], Len(3)] = Array([0.0] * 3)
    on: bool = False
    big: i64 = 0
    last: u16 = 0


class Led2(Message, name="r2p_msgs/Led"):
    other: u8 = 0


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["msg", *arguments], prog_name="r2p")


@pytest.fixture(autouse=True)
def _in_tmp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_all_known_types_are_listed(tmp_path: Path) -> None:
    (tmp_path / "r2p.toml").write_text(f'[types]\nmap = "{__name__}:Grid"\nleds = "Led"\n')
    rows = [json.loads(line) for line in run("list").stdout.splitlines()]
    assert {"type": "r2p_msgs/Led", "size": 5, "varies": False, "class": "r2p.msg:Led"} in rows
    own = {"type": "robot/Grid", "size": layout(Grid).size, "varies": False, "class": f"{__name__}:Grid"}
    assert [row for row in rows if row["type"].startswith("robot/")] == [own]
    assert len(rows) == len(standard_types()) + 1
    grid = json.loads(run("show", "robot/Grid").stdout)
    assert grid["fields"]["cells[2][1].class"] == "i8"
    assert (grid["ros1_md5"], grid["ros2_hash"]) == (None, None), "ROS has no arrays of arrays"


def test_show() -> None:
    assert json.loads(run("show", "PointField").stdout) == {
        "type": "sensor_msgs/PointField",
        "size": layout(PointField).size,
        "varies": True,
        "class": "r2p.msg:PointField",
        "fingerprint": layout(PointField).fingerprint.hex(),
        "ros1_md5": "268eacb2962780ceac86cbd17e328150",
        "ros2_hash": "RIHS01_5c6a4750728c2bcfbbf7037225b20b02d4429634732146b742dee1726637ef01",
        "fields": {"name": "str", "offset": "u32", "datatype": "u8", "count": "u32"},
    }


def test_show_of_a_service() -> None:
    """The sums are those of `rosservice` (`SetBool._md5sum`) and of rclpy."""
    assert json.loads(run("show", "std_srvs/SetBool").stdout) == {
        "type": "std_srvs/SetBool",
        "ros1_md5": "09fb03525b03e7ea1fd3992bafd87e16",
        "ros2_hash": "RIHS01_abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a",
        "request_fields": {"data": "bool"},
        "response_fields": {"success": "bool", "message": "str"},
    }


@pytest.mark.skipif(not COMPILERS, reason="no C compiler: apt-get install gcc g++")
def test_compilers_agree(tmp_path: Path) -> None:
    """The asserts hold in C and in C++, and the bytes of a struct are those of its message."""
    assert run("export", "--c", "include").exit_code == 0
    assert run("export", f"{__name__}:Grid", "--c", "include").exit_code == 0
    headers = sorted(path.relative_to(tmp_path / "include").as_posix() for path in tmp_path.rglob("*.h"))
    assert {"robot/Grid.h", "tests/Cell.h", "r2p_msgs/Timestamp.h", "r2p_msgs/Led.h"} <= {*headers}
    includes = "".join(f'#include "{path}"\n' for path in headers)
    (tmp_path / "program.c").write_text(
        includes + "#include <stdio.h>\nint main(void) {\n"
        "  robot_Grid grid = {{1, 2}, {}, {\"ab\", {'c', 'd', 'e', 'f', 'g'}}, {9}, {0.5f}, 1, -5, 513};\n"
        "  grid.cells[2][1].class_ = -1;\n  grid.cells[0][1].default_ = 7;\n"
        "  return fwrite(&grid, sizeof grid, 1, stdout) != 1;\n}\n"
    )
    cells = ((Cell(), Cell(default=7)), (Cell(), Cell()), (Cell(), Cell(class_=-1)))
    grid = Grid(Timestamp(1, 2), cells, ("ab", "cdefg"), b"\t" + bytes(6), Array([0.5, 0, 0]), True, -5, 513)
    for compiler in COMPILERS:
        language = "c++" if compiler.endswith("++") else "c"
        warnings = ["-Wall", "-Wextra", "-Werror", "-Wno-missing-field-initializers"]
        command = [compiler, "-x", language, *warnings, "-I", "include", "program.c", "-o", "program"]
        subprocess.run(command, check=True, cwd=tmp_path)
        packed = subprocess.run([tmp_path / "program"], check=True, capture_output=True).stdout
        assert packed == grid.encode()


def test_what_is_exported_by_default_and_what_is_not(tmp_path: Path) -> None:
    result = run("export", "--c", "include")
    fixed = [cls for cls in standard_types() if layout(cls).exact_size]
    assert {path.stem for path in tmp_path.rglob("*.h")} == {cls.__name__ for cls in fixed}
    assert "left out, as their length varies: r2p_msgs/BusTraffic, r2p_msgs/BusSlots, std_msgs/Empty" in result.stderr
    assert f"{len(fixed)} headers in include: compile with -I include" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "error"),
    [
        (["export", "Image", "--c", "d"], 2, "sensor_msgs/Image has no struct: its length varies"),
        (["export", "Empty", "--c", "d"], 2, "std_msgs/Empty has no struct: it has no bytes"),
        (["export", "Led", f"{__name__}:Led2", "--c", "d"], 2, "two different types are named r2p_msgs/Led: give one"),
        (["export", "Led", "--c", "r2p.toml"], 1, "can't write r2p.toml/r2p_msgs/Led.h: Not a directory"),
        (["export", "Led"], 2, "where to? give --c DIR for C headers, --ros1 DIR or --ros2 DIR for packages of ROS"),
        (["export", "LaserScan", "--ros2", "d"], 2, "all of these types are in packages that come with ROS 2"),
        (["export", f"{__name__}:Led2", "Led", "--ros1", "d"], 2, "two different types are named r2p_msgs/Led"),
        (["import", "LaserScan"], 2, "'LaserScan' is not the name of a ROS type, such as sensor_msgs/Imu"),
        (["import", "nothing/Nothing.msg"], 2, "can't read"),
        (["show", "sensor_msgs/Scan"], 2, "has a type sensor_msgs/Scan; did you mean sensor_msgs/LaserScan?"),
    ],
)
def test_mistakes(arguments: list[str], code: int, error: str, tmp_path: Path) -> None:
    (tmp_path / "r2p.toml").touch()
    result = run(*arguments)
    assert result.exit_code == code
    assert error in " ".join(result.stderr.split())


def test_a_header() -> None:
    text = c_header(layout(Led))
    assert "Generated by `r2p msg export`. Fingerprint 9ef58fbde4f40142, of\n   led:u32 value:u8 */" in text
    assert "typedef struct __attribute__((packed)) {\n  uint32_t led;\n  uint8_t value;\n} r2p_msgs_Led;" in text
    assert r2p.layout(Cell).schema == "temperature:f64 default:u8 class:i8"
    assert "comment: * / here" in c_header(layout(Cell))
