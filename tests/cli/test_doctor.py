"""`lerobot-agpd-doctor`: what it says of this installation, and of broken ones."""

import json
import logging
import sys

import pytest

from lerobot_agpd.cli import doctor
from lerobot_agpd.health import installation
from lerobot_agpd.health.finding import Severity
from lerobot_agpd.health.installation import DISTRIBUTION, examine_installation


def severities(findings, area):
    return {finding.severity for finding in findings if finding.area == area}


@pytest.fixture(scope="module")
def findings():
    return examine_installation()


def test_this_installation_is_not_broken(findings):
    pytest.importorskip(DISTRIBUTION)
    assert [finding for finding in findings if finding.severity is Severity.BROKEN] == []
    areas = {finding.area for finding in findings}
    assert areas == {"versions", "extras", "discovery", "rendering", "video", "processors"}
    assert all(finding.text and "\n" not in finding.text + finding.remedy for finding in findings)
    assert all(finding.remedy for finding in findings if finding.severity is not Severity.OK)


def test_versions_that_do_not_fit(monkeypatch):
    versions = {"lerobot": "0.7.1"}
    real = installation.version
    monkeypatch.setattr(installation, "version", lambda name: versions.get(name) or real(name))
    broken = [f for f in installation._versions() if f.severity is Severity.BROKEN]
    assert any("lerobot 0.7.1 instead of <0.7,>=0.6.1" in finding.text for finding in broken)


def test_a_missing_extra_is_a_note_with_its_command(monkeypatch):
    real = installation._installed
    monkeypatch.setattr(installation, "_installed", lambda name: name != "zarr" and real(name))
    (found,) = [finding for finding in installation._extras() if finding.text.startswith("zarr")]
    assert found.severity is Severity.NOTE and f"pip install '{DISTRIBUTION}[zarr]'" in found.remedy


def test_a_clash_of_names_is_broken():
    class Foreign:
        pass

    known = {"ours": Foreign, "good": type("Good", (), {"__module__": "a.module"})}
    ours = {"ours": "a.module", "good": "a.module", "lost": "b.module"}
    clash, lost = installation._types("--env.type", known, ours)
    assert clash.severity is lost.severity is Severity.BROKEN
    assert "--env.type=ours is" in clash.text and __name__ in clash.text
    assert "--env.type=lost is not registered" in lost.text and "python -c 'import b.module'" in lost.remedy


def test_a_plugin_that_cannot_be_imported_is_named(tmp_path, monkeypatch):
    name = "lerobot_policy_agpd_crooked"
    metadata = tmp_path / f"{name}-1.0.dist-info" / "METADATA"
    metadata.parent.mkdir()
    metadata.write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (tmp_path / f"{name}.py").write_text("1 / 0")
    monkeypatch.syspath_prepend(tmp_path)
    (found,) = [finding for finding in installation._discovery() if name in finding.text]
    assert found.severity is Severity.WARNING and "ZeroDivisionError" in found.text
    assert found.remedy.endswith(f"pip uninstall {name}")


@pytest.mark.parametrize("failure", ["raise RuntimeError('no display')", "os.abort()"])
def test_rendering_that_fails_or_aborts(monkeypatch, failure):
    pytest.importorskip("mujoco")
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.setattr(installation, "RENDER", f"import os; {failure}")
    (found,) = installation._rendering()
    assert found.severity is Severity.WARNING and "MUJOCO_GL=glfw cannot render" in found.text
    assert ("no display" if "display" in failure else "ended by signal 6") in found.text
    assert "apt-get install" in found.remedy
    where = "os.environ['MUJOCO_GL'] != 'osmesa'"
    monkeypatch.setattr(installation, "RENDER", f"import os\nif {where}: {failure}")
    (found,) = installation._rendering()
    assert found.remedy.startswith("export MUJOCO_GL=osmesa")


# ---- the command ----


def call(monkeypatch, *args):
    monkeypatch.setattr(sys, "argv", ["lerobot-agpd-doctor", *args])
    doctor.main()


def test_the_command_writes_what_it_shows(monkeypatch, tmp_path, capsys, caplog):
    monkeypatch.setattr(doctor, "examine_installation", lambda: [])
    file = tmp_path / "findings.json"
    with caplog.at_level(logging.ERROR):
        call(monkeypatch, f"--run={tmp_path}", f"--json={file}")
    written = json.loads(file.read_text())["findings"]
    assert [entry["severity"] for entry in written] == ["warning", "ok"]
    assert "1 warning" in capsys.readouterr().out


def test_the_command_ends_with_1_if_something_is_broken(monkeypatch, tmp_path, capsys):
    (tmp_path / "dataset").mkdir()
    monkeypatch.setenv("COLUMNS", "1000")
    monkeypatch.setattr(doctor, "examine_installation", lambda: [])
    with pytest.raises(SystemExit) as ended:
        call(monkeypatch, f"--dataset={tmp_path / 'dataset'}")
    assert ended.value.code == 1 and "info.json is missing" in capsys.readouterr().out


def test_a_folder_that_is_not_there(monkeypatch, tmp_path):
    with pytest.raises(SystemExit, match="lerobot-agpd-doctor: --run=.* is not a folder"):
        call(monkeypatch, f"--run={tmp_path / 'nowhere'}")
