"""What the description of a robot may start: xacro and packages of robots only where allowed."""

import pickle
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_line import environment
from refusals import refused

from cvqmpt_lab.base.modules import Code, allow_code
from cvqmpt_lab.cli.main import main
from cvqmpt_lab.robot.load import load_robot, robot_from_source

TOLD = "wh(ich|ose) .*: add --allow-code if you trust the file .in Python: call allow_code"
DEFINED = """<xacro:property name="width" value="${2 * pi}"/>
<xacro:arg name="prefix" default=""/>
<xacro:macro name="tip" params="at"><link name="${at}"/></xacro:macro></robot>"""
OWNED = "open('{}', 'w').write('code of a file ran')"


@pytest.fixture(autouse=True)
def code_not_allowed(monkeypatch):
    monkeypatch.setattr(Code, "allowed", False)


def test_a_xacro_file_is_expanded_where_xacrodoc_is_installed(edited, tmp_path, monkeypatch):
    """The packages beside the file are made known, and a changed included file is noticed."""
    allow_code()
    urdf, macro = edited(("</robot>", "<xacro:tip/></robot>")), tmp_path / "tip.xacro"
    monkeypatch.setitem(sys.modules, "xacro", None)
    refused(rf"{urdf.name}.*pip install xacrodoc.*xacro {urdf.name} >", load_robot, urdf, "tool")
    (tmp_path / "package.xml").write_text("<package><name>arm</name></package>")
    macro.write_text("<link/>")
    known, found = {}, [macro]

    def process_file(name):
        xacro.all_includes += map(str, found)
        if not found:
            raise ValueError("package nowhere\nis not found")
        expanded = Path(name).read_text().replace("<xacro:tip/>", "<!-- no tip -->")
        return SimpleNamespace(toxml=lambda: expanded)

    xacro = SimpleNamespace(all_includes=["old"], process_file=process_file)
    packages = SimpleNamespace(update_package_cache=known.update, walk_up_from=lambda path: None)
    monkeypatch.setitem(sys.modules, "xacro", xacro)
    monkeypatch.setitem(sys.modules, "xacrodoc", SimpleNamespace(packages=packages))
    robot = load_robot(urdf, "tool")
    assert robot.dof == 4 and known[tmp_path.name] == tmp_path
    assert [path for path, _ in robot.files] == [str(urdf.resolve()), str(macro)]
    found.clear()
    refused(
        r"cannot expand .*: package nowhere is not found; .*NAME:=VALUE", load_robot, urdf, "tool"
    )


@pytest.mark.parametrize(
    "used",
    [
        '<link name="${(lambda: 1)()}"/>',
        '<link name="$(env HOME)"/>',
        "<xacro:tip at='x'/>",
        "<tip at='x'/>",
        '<xacro:include filename="other.xacro"/>',
        '<xacro:if value="1"><link name="x"/></xacro:if>',
    ],
)
def test_nothing_is_expanded_by_xacro_where_code_is_not_allowed(edited, monkeypatch, used):
    never = SimpleNamespace(process_file=lambda path: pytest.fail("expanded"))
    monkeypatch.setitem(sys.modules, "xacro", never)
    urdf = edited(("</robot>", used + DEFINED))
    told = refused(TOLD, load_robot, urdf, "tool")
    assert "or expand it by hand: xacro arm.urdf > expanded.urdf" in told
    assert main(["robot", str(urdf)]) == 2


def test_definitions_of_xacro_that_nothing_uses_are_ignored_with_a_note(edited, slider_arm):
    robot = load_robot(edited(("</robot>", DEFINED)), "tool")
    assert robot.kinematics_digest == slider_arm.kinematics_digest
    (note,) = [note for note in robot.notes if "xacro" in note]
    assert note == (
        "arm.urdf: elements of xacro that nothing uses are ignored: <xacro:property name='width'>, "
        "<xacro:arg name='prefix'>, <xacro:macro name='tip'>"
    )
    plain = edited(("<robot ", '<robot xmlns:xacro="http://ros.org/wiki/xacro" '), name="b.urdf")
    assert not [note for note in load_robot(plain, "tool").notes if "xacro" in note]


def test_a_pickled_robot_is_built_again_where_its_files_may_start_code(slider_arm):
    allow_code()
    data = pickle.dumps(slider_arm)
    Code.allowed = False
    pickle.loads(data)
    assert Code.allowed


def package(folder, text):
    """Write a package robot_descriptions with the robot two_links."""
    place = folder / "robot_descriptions"
    place.mkdir(parents=True)
    (place / "__init__.py").write_text("")
    (place / "two_links_description.py").write_text(text)


def test_a_robot_of_a_package_is_never_a_file_of_the_working_folder(
    tmp_path, monkeypatch, slider_arm_urdf
):
    """Neither the working folder nor the folder of the script is searched, installed or not."""
    here, installed, owned = tmp_path / "here", tmp_path / "installed", tmp_path / "owned"
    package(here, OWNED.format(owned))
    for name in list(sys.modules):
        if name.startswith("robot_descriptions"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.chdir(here)
    monkeypatch.syspath_prepend(here)
    source = {"name": "rd:two_links", "end_effector": "tool"}
    refused(TOLD, robot_from_source, source)
    allow_code()
    refused("no installed package robot_descriptions", robot_from_source, source)
    package(installed, f"URDF_PATH = {str(slider_arm_urdf)!r}")
    made = installed / "robot_descriptions-1.0.dist-info"
    made.mkdir()
    (made / "METADATA").write_text("Metadata-Version: 2.1\nName: robot_descriptions\nVersion: 1.0")
    monkeypatch.syspath_prepend(installed)
    sys.path.insert(0, str(here))
    try:
        assert robot_from_source(source).dof == 4
        refused("its name is no word", robot_from_source, {"name": "rd:loaders.two_links"})
    finally:
        for name in [name for name in sys.modules if name.startswith("robot_descriptions")]:
            del sys.modules[name]
    assert not owned.exists()


def test_a_script_beside_a_package_does_not_import_it(tmp_path):
    owned, script = tmp_path / "owned", tmp_path / "script.py"
    package(tmp_path, OWNED.format(owned))
    script.write_text(
        "from cvqmpt_lab import allow_code, robot_from_source\nallow_code()\n"
        "robot_from_source({'name': 'rd:two_links'})\n"
    )
    done = subprocess.run(
        [sys.executable, str(script)], env=environment(), capture_output=True, text=True
    )
    assert "no installed package robot_descriptions" in done.stderr and not owned.exists()
