"""Python source of ROS types, and packages for ROS of r2p's types."""

from pathlib import Path
from typing import Annotated, Any

import pytest

import r2p
from r2p.msg import Header, LaserScan
from r2p.ros.classes import RosTypes
from r2p.ros.definitions import md5, parse
from r2p.ros.library import DefinitionFile, definitions_of_ros, ros1_md5, ros2_hash
from r2p.ros.packages import packages
from r2p.ros.source import source
from r2p.tools.types import standard_types

SERVICE = """# Moves the arm.
uint8 SLOW=0
string NOTE=a # b
float64 PI = 3.14
bool OK = true
int32 MASK=0x10
float64 FAR=inf
geometry_msgs/Pose pose
string[] from   # where
my_other_msgs/Joint[<=6] joints
---
uint8[4] class
bool[2] done
"""


def run(text: str) -> dict[str, Any]:
    names: dict[str, Any] = {}
    exec(text, names)  # noqa: S102 - the source is what is tested
    return names


@pytest.fixture
def service(tmp_path: Path) -> Path:
    (tmp_path / "my_msgs" / "srv").mkdir(parents=True)
    (tmp_path / "my_other_msgs" / "msg").mkdir(parents=True)
    (tmp_path / "my_other_msgs" / "msg" / "Joint.msg").write_text("float32 angle\n", "utf-8-sig")
    file = tmp_path / "my_msgs" / "srv" / "Move.srv"
    file.write_text(SERVICE)
    return file


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", ["sensor_msgs/BatteryState", "diagnostic_msgs/DiagnosticArray", "nav_msgs/Odometry"])
def test_source_of_a_type_of_ros_has_its_bytes(name: str, version: int) -> None:
    definitions = definitions_of_ros(name, version)
    made = RosTypes(version, definitions).load(name)
    cls = run(source([made], definitions, 1000))[name.partition("/")[2]]
    assert (r2p.layout(cls).schema, r2p.layout(cls).name) == (r2p.layout(made).schema, name)
    assert cls().encode() == made().encode()


NESTED = "\n" + "=" * 80 + "\nMSG: "
POINT = f"{NESTED}geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z"


@pytest.mark.parametrize(
    "text",
    [
        "float32 str\nstring a\nstring[] b\nuint8[4] bytes\nfloat32[3] tuple\nfloat32 r2p\nfloat32[] c\ntime d",
        "int32 int=3\nbool bool=true\nfloat32 float=inf\nint32 x=1\nbool y\nfloat32 z=nan\nstring str=a\nstring a",
        "string ClassVar=b\nint8 c=1\nbool Annotated\nstring last\nfloat32 class\nfloat32 class_2",
        f"Point Point\nPoint other\nHeader Header\nHeader h{NESTED}my_msgs/Point\nfloat32 x",
        f"a/Point a\nb/Point b{NESTED}a/Point\nfloat32 x{NESTED}b/Point\nfloat32 y",
        f"None a\nstr b\nr2p c{NESTED}my_msgs/None\nbool x{NESTED}my_msgs/str\nbool y{NESTED}my_msgs/r2p\nbool z",
        f"geometry_msgs/Point a\nPoint b{NESTED}geometry_msgs/Point\nfloat64[3] x{NESTED}my_msgs/Point\nbool x",
        f"Point b\ngeometry_msgs/Point a\nint8 Point_{NESTED}my_msgs/Point\nbool x{POINT}",
        "# A text\0 with\x1b[31m colours.\nfloat32 x",
    ],
)
def test_source_of_types_with_names_that_python_uses(text: str) -> None:
    definitions = parse("my_msgs/Odd", text)
    made = RosTypes(1, definitions).load("my_msgs/Odd")
    cls = run(source([made], definitions, 1000))["Odd"]
    assert r2p.layout(cls).schema == r2p.layout(made).schema
    assert cls().encode() == made().encode()
    assert cls.__doc__.isprintable()


def test_types_that_r2p_has_are_imported() -> None:
    definitions = definitions_of_ros("sensor_msgs/LaserScan", 2)
    assert RosTypes(2, definitions).load("sensor_msgs/LaserScan") is LaserScan
    assert source([LaserScan], definitions, 9) == "import r2p\nfrom r2p.msg import LaserScan\n"


def test_a_service_with_types_of_other_packages(service: Path) -> None:
    names, definitions = DefinitionFile(service).read(2)
    types = RosTypes(2, definitions)
    found = run(source([types.load(name) for name in names], definitions, 7))
    request, response = found["Move_Request"], found["Move_Response"]
    assert (request.SLOW, request.NOTE, request.PI, request.OK, request.MASK) == (0, "a # b", 3.14, True, 16)
    assert request.__doc__ == "Moves the arm."
    assert r2p.layout(request).schema.endswith(" from[]:str joints[].angle:f32")
    assert request(from_=("here",) * 7).encode()
    with pytest.raises(r2p.MessageError, match="at most 7"):
        request(from_=("here",) * 8).encode()
    assert response().class_ == bytes(4)


def test_ros1_names_the_parts_of_services_without_an_underscore(service: Path) -> None:
    names, _ = DefinitionFile(service).read(1)
    assert names == ["my_msgs/MoveRequest", "my_msgs/MoveResponse"]


def test_mistakes(tmp_path: Path, service: Path) -> None:
    with pytest.raises(r2p.MessageError, match="did you mean sensor_msgs/Imu"):
        definitions_of_ros("sensor_msgs/Imuu", 2)
    with pytest.raises(r2p.MessageError, match="can't read"):
        DefinitionFile(tmp_path / "my_msgs" / "msg" / "Nothing.msg").read(2)
    (tmp_path / "my_other_msgs" / "msg" / "Joint.msg").unlink()
    with pytest.raises(r2p.MessageError, match="Move_Request needs my_other_msgs/Joint, but there is no"):
        DefinitionFile(service).read(2)


@pytest.mark.parametrize("version", [1, 2])
def test_packages_of_the_standard_types(version: int) -> None:
    files = packages(standard_types(), version)
    assert files["r2p_msgs/msg/Led.msg"] == "uint32 led\nuint8 value\n"
    stamp = "time timestamp" if version == 1 else "builtin_interfaces/Time timestamp"
    assert stamp in files["r2p_msgs/msg/StampedEncoder.msg"]
    assert not any(path.startswith("sensor_msgs/") for path in files)
    cmake = files["r2p_msgs/CMakeLists.txt"]
    assert all(path.rpartition("/")[2] in cmake for path in files if path.endswith(".msg"))
    assert f'<package format="{version + 1}">' in files["r2p_msgs/package.xml"]
    text = files["r2p_msgs/msg/Led.msg"]
    assert md5("r2p_msgs/Led", parse("r2p_msgs/Led", text)) == "004c3c9a6f99efbd0231bbcef249f38c"


class Grid(r2p.Message, name="my_msgs/Grid"):
    header: Header
    cells: Annotated[tuple[Annotated[tuple[r2p.u8, ...], r2p.Len(2)], ...], r2p.Len(2)]


class oddMotor(r2p.Message, name="my_msgs/oddMotor"):  # noqa: N801 - what is tested
    speed: r2p.f32


class Motor(r2p.Message, name="my_msgs/Motor"):
    maxSpeed: r2p.f32  # noqa: N815 - what is tested


@pytest.mark.parametrize(
    ("cls", "error"),
    [
        (Grid, "my_msgs/Grid.cells: ROS has no arrays of arrays"),
        (oddMotor, "names of types"),
        (Motor, "names of field"),
    ],
)
def test_what_ros2_can_not_define(cls: type[r2p.Message], error: str) -> None:
    with pytest.raises(r2p.MessageError, match=error):
        packages([cls], 2)


def test_sums_are_those_of_ros_where_it_has_the_type() -> None:
    assert ros1_md5(LaserScan) == "90c7ef2dc6895d81024acba2ac42f369"
    assert ros2_hash(LaserScan) == "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828"
    assert ros1_md5(r2p.msg.Led) == "004c3c9a6f99efbd0231bbcef249f38c"

    class Imu(r2p.Message, name="sensor_msgs/Imu"):
        x: r2p.f32

    with pytest.raises(r2p.MessageError, match="sensor_msgs/Imu of ROS 1 has other fields than Imu"):
        ros1_md5(Imu)
