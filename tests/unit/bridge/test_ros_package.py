"""``deploy/ros2/streetfix_ros``: the package describes what it installs and imports, and its node starts the bridge."""

import ast
import runpy
import signal
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from service.bridge import in_place
from service.bridge.known import Known
from service.bridge.settings import about, parameters
from service.contract.schema import LocalizeAnswer
from service.imaging.level import GivenHeight

ROOT = Path(__file__).parents[3]
PACKAGE = ROOT / "deploy" / "ros2" / "streetfix_ros"
CONFIG, LAUNCH = PACKAGE / "config" / "streetfix.yaml", PACKAGE / "launch" / "streetfix.launch.py"
#: Packages that carry another name in Python, by their key of rosdep.
KEYS = {"yaml": "python3-yaml"}
S = 10**9


def imported_by(*files: Path) -> set[str]:
    """Return the top-level packages that files import, also inside functions or by name."""
    found = set[str]()
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                found |= {each.name for each in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found.add(node.module)
            elif isinstance(node, ast.Constant) and str(node.value).endswith("_msgs.msg"):
                found.add(str(node.value))
    return {name.partition(".")[0] for name in found}


def package() -> ElementTree.Element:
    return ElementTree.parse(PACKAGE / "package.xml").getroot()  # noqa: S314  # our own file


def told(name: str) -> str:
    return str(package().findtext(name))


@pytest.fixture
def setup_of(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return the arguments that ``setup.py`` passes to setuptools."""
    given: dict[str, Any] = {}
    module = ModuleType("setuptools")
    module.__dict__["setup"] = lambda **arguments: given.update(arguments)
    monkeypatch.setitem(sys.modules, "setuptools", module)
    runpy.run_path(str(PACKAGE / "setup.py"))
    return given


def test_the_package_has_our_name_licence_version_and_build_type() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (package().tag, package().get("format")) == ("package", "3")
    assert (told("name"), told("license"), told("version")) == (
        "streetfix_ros",
        declared["license"],
        declared["version"],
    )
    assert told("export/build_type") == "ament_python"


def test_the_package_depends_on_what_its_code_imports() -> None:
    imported = imported_by(
        *(PACKAGE / "streetfix_ros").glob("*.py"), LAUNCH, ROOT / "service" / "bridge" / "rclpy_node.py"
    )
    ours = sys.stdlib_module_names | {"service"}
    dependencies = [element.text for element in package() if element.tag.endswith("depend")]
    assert sorted(map(str, dependencies)) == sorted(KEYS.get(name, name) for name in imported - ours)


def test_setup_installs_every_file_and_says_what_the_package_says(setup_of: dict[str, Any]) -> None:
    assert {name: setup_of[name] for name in ("name", "version", "license")} == {
        name: told(name) for name in ("name", "version", "license")
    }
    maintainer = package().find("maintainer")
    assert maintainer is not None
    assert (setup_of["maintainer"], setup_of["maintainer_email"]) == (maintainer.text, maintainer.get("email"))
    installed = {PACKAGE / file for _, files in setup_of["data_files"] for file in files}
    wanted = {PACKAGE / "package.xml", PACKAGE / "resource" / "streetfix_ros", CONFIG, LAUNCH}
    assert installed == wanted
    assert all(file.is_file() for file in wanted)
    assert setup_of["packages"] == ["streetfix_ros"]
    assert setup_of["entry_points"] == {"console_scripts": ["bridge = streetfix_ros.bridge:main"]}


def test_ros_finds_the_executable_where_setup_puts_it() -> None:
    assert "install_scripts=$base/lib/streetfix_ros" in (PACKAGE / "setup.cfg").read_text()


def test_the_parameter_file_has_every_parameter_with_its_default() -> None:
    assert yaml.safe_load(CONFIG.read_text()) == {"/**": {"ros__parameters": parameters()}}


@pytest.mark.parametrize("name", list(parameters()))
def test_the_comment_above_a_parameter_says_what_it_means(name: str) -> None:
    above = CONFIG.read_text().partition(f"\n    {name}: ")[0].rpartition("\n\n")[2]
    comment = " ".join(line.strip().removeprefix("# ") for line in above.splitlines())
    assert comment.startswith(about(name))


def test_node_and_launch_file_know_the_same_names() -> None:
    from service.bridge.rclpy_node import NODE

    assert f'name="{NODE}"' in LAUNCH.read_text()
    assert f"`{NODE}`" in CONFIG.read_text()


@pytest.fixture
def node(ros: Any) -> dict[str, Any]:
    """Load the module of the node with a fake rclpy."""
    return runpy.run_path(str(PACKAGE / "streetfix_ros" / "bridge.py"))


def test_the_node_declares_every_parameter_and_says_what_it_means(ros: Any, node: dict[str, Any]) -> None:
    ros.given = {"rate": 0.25, "frame": "earth"}
    settings = node["declared"](ros)
    assert (settings.rate, settings.frame, settings.min_confidence, settings.map) == (0.25, "earth", 0.9, None)
    assert {name: each.default for name, each in ros.declared.items()} == parameters()
    for name, each in ros.declared.items():
        assert (each.descriptor.description, each.descriptor.read_only) == (about(name), True)


def test_the_node_answers_images_until_a_signal(
    ros: Any,
    node: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    image_of: Callable[..., Any],
    info_of: Callable[..., Any],
    answer_of: Callable[..., LocalizeAnswer],
    odometry_of: Callable[..., Any],
    initial_pose_of: Callable[..., Any],
) -> None:
    opened, asked = list[Path](), list[Known]()

    def of(bundle: Path, rate: float | None) -> Callable[..., LocalizeAnswer]:
        assert rate is None
        opened.append(bundle)

        def answer(*given: Any) -> LocalizeAnswer:
            asked.append(given[-1])
            return answer_of()

        return answer

    monkeypatch.setattr(in_place, "InPlace", of)
    ros.given = {
        "map": "maps/site",
        "pose_topic": "/pose",
        "frame": "earth",
        "mount": "0,0,0,-0.5,0.5,-0.5,0.5",
        "base_on_ground": True,
        "camera_height_m": 0.3,
        "right_info_topic": "/right/camera_info",
        "reliable": True,
        "queue": 0,
    }

    def see() -> None:
        ros.subscriptions["/odom"].heard(odometry_of(5 * S, 0.0, 0.0))
        ros.subscriptions["/initialpose"].heard(initial_pose_of(0.0, 0.0, frame="odom"))
        ros.subscriptions["/camera/color/camera_info"].heard(info_of(0))
        ros.subscriptions["/right/camera_info"].heard(info_of(p=[400.0, 0, 0, -48.0, 0, 400.0, 0, 0, 0, 0, 1, 0]))
        color, depth = np.zeros((4, 6, 3), np.uint8), np.ones((4, 6), np.float32)
        ros.subscriptions["/camera/color/image_raw"].heard(image_of(color, "rgb8", 5 * S))
        ros.subscriptions["/camera/aligned_depth_to_color/image_raw"].heard(image_of(depth, "32FC1", 5 * S))

    ros.turns, ros.no_more = [see], lambda: signal.raise_signal(signal.SIGINT)
    assert node["main"](["--ros-args"]) == 0
    assert opened == [Path("maps/site")]
    (known,) = asked
    assert (known.camera_height, known.baseline_m) == (GivenHeight(0.3, 0.05), 0.12)
    assert known.motion is not None
    (pose,) = ros.published["/pose"]
    assert (pose.header.frame_id, pose.pose.pose.position.x) == ("earth", 10.0)
    images = {each.qos.history for each in ros.subscriptions.values() if each.kind in ("Image", "CameraInfo")}
    assert images == {"all"}
    (listening, warning, line) = ros.logged
    assert listening[1].startswith("listening to /camera/color/image_raw and ")
    assert (line[0], line[1].partition("  ")[0]) == ("info", "5.000 LOCALIZED 0.950")
    assert warning[0] == "warning"
    assert warning[1].startswith("/initialpose: a pose has the frame 'odom'")
    assert (ros.args, ros.domain, ros.ended) == (["--ros-args"], None, ["node", "shutdown"])


def test_a_parameter_that_makes_no_sense_ends_the_node_with_the_remedy(ros: Any, node: dict[str, Any]) -> None:
    ros.given = {"mount": "1,2"}
    assert node["main"]() == 1
    ((level, text),) = ros.logged
    assert level == "fatal"
    assert text.startswith("--mount: '1,2' is invalid; give X,Y,Z,QX,QY,QZ,QW")
    assert ros.ended == ["node", "shutdown"]


@pytest.fixture
def launch(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Load the launch file with fakes of launch and launch_ros that record their arguments."""
    # An argument of the launch is a name here, and the context a mapping from names to texts.
    modules: dict[str, dict[str, Any]] = {
        "ament_index_python": {},
        "ament_index_python.packages": {"get_package_share_directory": lambda name: str(PACKAGE.parent / name)},
        "launch": {"LaunchContext": dict, "LaunchDescription": list},
        "launch.actions": {
            "DeclareLaunchArgument": lambda name, **rest: SimpleNamespace(name=name, **rest),
            "OpaqueFunction": SimpleNamespace,
        },
        "launch.substitutions": {
            "LaunchConfiguration": lambda name: SimpleNamespace(
                name=name, perform=lambda context: context.get(name, "")
            )
        },
        "launch_ros": {},
        "launch_ros.actions": {"Node": SimpleNamespace},
        "launch_ros.parameter_descriptions": {"ParameterValue": lambda value, value_type: value_type(value)},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return runpy.run_path(str(LAUNCH))


def test_every_parameter_is_an_argument_of_the_launch(launch: dict[str, Any]) -> None:
    *arguments, start = launch["generate_launch_description"]()
    assert [each.name for each in arguments[:3]] == ["params_file", "namespace", "log_level"]
    assert sorted(each.name for each in arguments[3:]) == sorted(parameters())
    assert (arguments[0].default_value, start.args) == (str(CONFIG), [parameters()])
    rate = next(each for each in arguments if each.name == "rate")
    assert (rate.default_value, rate.description) == ("", "Overrides rate of params_file. The package's file says 1.0.")


def test_only_arguments_that_are_given_override_the_file(launch: dict[str, Any]) -> None:
    context = {"rate": "2", "queue": "0", "rectified": "True", "map_name": "5"}
    (node,) = launch["start"](context, parameters())
    file, overrides = node.parameters
    assert file.name == "params_file"
    assert overrides == {"map_name": "5", "rectified": True, "rate": 2.0, "queue": 0}
    assert [type(value) for value in overrides.values()] == [str, bool, float, int]
    assert (node.package, node.executable, node.name) == ("streetfix_ros", "bridge", "streetfix_bridge")
    (plain,) = launch["start"]({}, parameters())
    assert [each.name for each in plain.parameters] == ["params_file"]


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("rate", "fast", "rate:=fast is not a number such as 1.0; the package's file says 1.0"),
        ("queue", "1.5", "queue:=1.5 is not a number such as 5; the package's file says 5"),
        ("reliable", "yes", "reliable:=yes is not true or false; the package's file says False"),
    ],
)
def test_an_argument_of_a_wrong_type_is_reported(launch: dict[str, Any], name: str, text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        launch["value_of"](name, text, parameters()[name])
