"""Examine the installation: versions, extras, plugin discovery, rendering, video libraries, processors."""

from __future__ import annotations

import importlib
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Mapping
from importlib.metadata import PackageNotFoundError, distributions, requires, version

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
from packaging.requirements import Requirement

from lerobot_agpd.cards.install import DISTRIBUTION, install_command
from lerobot_agpd.health.finding import Finding, Severity
from lerobot_agpd.plugin import ENV_TYPES, POLICY_TYPES
from lerobot_agpd.trust import plugins

SHOWN = ("lerobot", "torch", "torchvision", "numpy", "datasets", "accelerate", "diffusers", "gymnasium")
"""Packages whose versions say most."""

RENDER = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).render()"
"""Opens a graphics context; run in a process of its own, since a broken driver can end the whole process."""

BACKENDS = ("egl", "osmesa")
"""Values of MUJOCO_GL that need no screen."""

RENDER_SECONDS = 60


def examine_installation() -> list[Finding]:
    """Everything about the installation; changes nothing, and asks nobody over the network."""
    return [*_versions(), *_extras(), *_discovery(), *_rendering(), *_video(), *_processors()]


# ---- packages ----


def _versions() -> Iterator[Finding]:
    known = [f"{name} {version(name)}" for name in SHOWN if _installed(name)]
    shown = ", ".join([f"python {platform.python_version()}", *known])
    wrong = list(_unmet(DISTRIBUTION, ""))
    if not wrong:
        yield Finding(Severity.OK, "versions", shown)
        return
    yield Finding(Severity.NOTE, "versions", shown)
    for problem in wrong:
        yield Finding(Severity.BROKEN, "versions", problem, install_command())


def _extras() -> Iterator[Finding]:
    """Which optional parts are there; a missing one is no fault."""
    extras = (
        importlib.metadata.metadata(DISTRIBUTION).get_all("Provides-Extra")
        if _installed(DISTRIBUTION)
        else []
    )
    for extra in extras or []:
        missing = list(_unmet(DISTRIBUTION, extra))
        if extra == "all":  # the others
            continue
        if missing:
            remedy = f"if you need it: pip install '{DISTRIBUTION}[{extra}]'"
            yield Finding(Severity.NOTE, "extras", f"{extra}: {'; '.join(missing)}", remedy)
        else:
            yield Finding(Severity.OK, "extras", f"{extra} is installed")


def _unmet(distribution: str, extra: str) -> Iterator[str]:
    """Requirements of a distribution, or of one of its extras alone, that the installed packages do not meet."""
    if not _installed(distribution):
        yield f"{distribution} is not installed"
        return
    for line in requires(distribution) or []:
        requirement = Requirement(line)
        if not _belongs(requirement, extra):
            continue
        if not _installed(requirement.name):
            yield f"{requirement.name} is not installed"
        elif not requirement.specifier.contains(version(requirement.name), prereleases=True):
            yield f"{requirement.name} {version(requirement.name)} instead of {requirement.specifier}"
        for inner in requirement.extras:
            yield from _unmet(requirement.name, inner)


def _belongs(requirement: Requirement, extra: str) -> bool:
    """Whether a requirement applies here, and because of the extra alone."""
    marker = requirement.marker
    if marker is None:
        return not extra
    return marker.evaluate({"extra": extra}) and (not extra or not marker.evaluate({"extra": ""}))


def _installed(name: str) -> bool:
    try:
        version(name)
    except PackageNotFoundError:
        return False
    return True


# ---- discovery ----


def _discovery() -> Iterator[Finding]:
    names = sorted(plugins())
    if DISTRIBUTION not in names:
        yield Finding(
            Severity.BROKEN,
            "discovery",
            f"LeRobot finds no installed distribution {DISTRIBUTION}: its commands know none of our types",
            f"{install_command()}, in the environment of {sys.executable}",
        )
    for name in sorted(set(names)):
        copies = [entry for entry in distributions() if entry.metadata.get("Name") == name]
        if len(copies) > 1:
            places = ", ".join(str(entry.locate_file("")) for entry in copies)
            yield Finding(
                Severity.WARNING,
                "discovery",
                f"{name} is installed {len(copies)} times: {places}",
                "keep one",
            )
        try:
            importlib.import_module(name)
        except Exception as error:  # whatever somebody else's package raises
            severity = Severity.BROKEN if name == DISTRIBUTION else Severity.WARNING
            yield Finding(
                severity,
                "discovery",
                f"the plugin {name} cannot be imported ({type(error).__name__}: {' '.join(str(error).split())})",
                f"repair or uninstall it: pip uninstall {name}",
            )
        else:
            yield Finding(Severity.OK, "discovery", f"the plugin {name} is found and can be imported")
    yield from _types("--policy.type", PreTrainedConfig.get_known_choices(), POLICY_TYPES)
    yield from _types("--env.type", EnvConfig.get_known_choices(), ENV_TYPES)


def _types(flag: str, known: Mapping[str, type], ours: Mapping[str, str]) -> Iterator[Finding]:
    """Whether the names of our types are ours."""
    wrong = 0
    for name, module in ours.items():
        holder = known.get(name)
        if holder is None:
            wrong += 1
            remedy = f"see why: python -c 'import {module}'"
            yield Finding(Severity.BROKEN, "discovery", f"{flag}={name} is not registered", remedy)
        elif holder.__module__ != module:
            wrong += 1
            package = holder.__module__.partition(".")[0]
            yield Finding(
                Severity.BROKEN,
                "discovery",
                f"{flag}={name} is {holder.__qualname__} of {holder.__module__}, not ours",
                f"uninstall the package that {package} belongs to, or use an environment without it",
            )
    if not wrong:
        yield Finding(Severity.OK, "discovery", f"{flag}: {', '.join(ours)}")


# ---- rendering and video ----


def _rendering() -> Iterator[Finding]:
    if not _installed("mujoco"):
        remedy = f"for its environments: pip install '{DISTRIBUTION}[fetch]'"
        yield Finding(Severity.NOTE, "rendering", "MuJoCo is not installed", remedy)
        return
    chosen = os.environ.get("MUJOCO_GL", "")
    shown = f"MUJOCO_GL={chosen}" if chosen else "MuJoCo, MUJOCO_GL is not set,"
    error = _render_error(chosen)
    if error is None:
        yield Finding(Severity.OK, "rendering", f"{shown} renders")
        return
    working = next((name for name in BACKENDS if name != chosen and _render_error(name) is None), None)
    remedy = (
        f"export MUJOCO_GL={working}, which works here" if working else "apt-get install libegl1 libosmesa6"
    )
    text = f"{shown} cannot render ({error}); observations of states need no rendering"
    yield Finding(Severity.WARNING, "rendering", text, remedy)


def _render_error(backend: str) -> str | None:
    """What goes wrong if MuJoCo renders, in a process of its own; None if it works."""
    env = {**os.environ, "MUJOCO_GL": backend} if backend else dict(os.environ)
    try:
        done = subprocess.run(  # noqa: S603  # this interpreter, a constant program
            [sys.executable, "-c", RENDER], capture_output=True, text=True, env=env, timeout=RENDER_SECONDS
        )
    except subprocess.TimeoutExpired:
        return f"no picture after {RENDER_SECONDS} s"
    if done.returncode == 0:
        return None
    if done.returncode < 0:
        return f"the process was ended by signal {-done.returncode}"
    return (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]


def _video() -> Iterator[Finding]:
    """LeRobot decodes videos with torchcodec, else with PyAV."""
    errors = {}
    for name, module in (("torchcodec", "torchcodec.decoders"), ("PyAV", "av")):
        try:
            importlib.import_module(module)
        except Exception as error:  # a missing ffmpeg is a RuntimeError
            text = str(error).strip() or type(error).__name__
            errors[name] = f"{name}: {text.partition('. ')[0].splitlines()[0]}"
    if not errors:
        yield Finding(Severity.OK, "video", "torchcodec and PyAV can be imported")
    elif len(errors) == 1:
        (name,) = errors
        other = "PyAV" if name == "torchcodec" else "torchcodec"
        text = f"{errors[name]}; LeRobot decodes videos with {other}"
        yield Finding(Severity.NOTE, "video", text, "if you want it: apt-get install ffmpeg")
    else:
        text = f"videos cannot be decoded ({'; '.join(errors.values())})"
        yield Finding(Severity.WARNING, "video", text, "apt-get install ffmpeg; pip install av")


# ---- processors ----


def _processors() -> Iterator[Finding]:
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    text = f"{allowed} of {os.cpu_count()} processor cores, {torch.get_num_threads()} torch threads"
    if torch.get_num_threads() > (allowed or 1):
        remedy = f"export OMP_NUM_THREADS={allowed}"
        yield Finding(Severity.WARNING, "processors", f"{text}: more threads than cores", remedy)
    else:
        yield Finding(Severity.OK, "processors", text)
    if torch.cuda.is_available():
        cards = [torch.cuda.get_device_properties(index) for index in range(torch.cuda.device_count())]
        listed = ", ".join(f"{card.name} ({card.total_memory / 2**30:.0f} GiB)" for card in cards)
        yield Finding(Severity.OK, "processors", f"CUDA {torch.version.cuda}: {listed}")
    elif torch.backends.mps.is_available():
        yield Finding(Severity.OK, "processors", "Apple MPS")
    else:
        yield Finding(
            Severity.NOTE,
            "processors",
            f"no GPU that torch {torch.__version__} can use",
            "pass --policy.device=cpu; if there is a GPU, check its driver with nvidia-smi",
        )
