"""Damage to files: demonstrations, a teacher, a run."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from fault import Bench
from safetensors.torch import load_file, save_file

Injection = Callable[[Bench], list[str]]


def truncate(path: Path) -> None:
    """Cut a file in half."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def remove(path: Path) -> None:
    """Remove a file or folder."""
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def garble(path: Path) -> None:
    """Exchange the first line of an index."""
    path.write_text("{not json\n" + path.read_text().partition("\n")[2])


# ---- what is damaged, and with which command the run then starts ----


def demonstrations(pattern: str, damage: Callable[[Path], None]) -> Injection:
    """Damage a file of the demonstrations."""

    def inject(bench: Bench) -> list[str]:
        damage(sorted(bench.demos.glob(pattern))[0])
        return bench.begin()

    return inject


def teacher(pattern: str, damage: Callable[[Path], None], *more: str) -> Injection:
    """Damage a file of the teacher's checkpoint."""

    def inject(bench: Bench) -> list[str]:
        damage(sorted(bench.teacher.glob(pattern))[0])
        return bench.begin(*more)

    return inject


def run(pattern: str, damage: Callable[[Path], None], *more: str) -> Injection:
    """Damage a file of a run that is then resumed from its checkpoint after step 3."""

    def inject(bench: Bench) -> list[str]:
        damage(sorted(bench.finished().glob(pattern))[0])
        return bench.resume(*more)

    return inject


# ---- numbers ----


def number(key: str, value: float) -> Callable[[Path], None]:
    """Exchange one number of a feature in a parquet file, in the third frame of the second episode."""

    def damage(path: Path) -> None:
        table = pq.read_table(path)
        column = np.array(table[key].to_pylist(), dtype=np.float32)  # (T, D)
        column[10, 0] = value
        field = table.schema.field(key)
        pq.write_table(
            table.set_column(
                table.schema.get_field_index(key), field, pa.array(column.tolist(), type=field.type)
            ),
            path,
        )

    return damage


def statistic(path: Path) -> None:
    """Make a standard deviation NaN."""
    stats = json.loads(path.read_text())
    stats["observation.state"]["std"][0] = float("nan")
    path.write_text(json.dumps(stats))


def rate(path: Path) -> None:
    """Say that demonstrations were recorded at 25 frames per second."""
    info = json.loads(path.read_text())
    path.write_text(json.dumps({**info, "fps": 25}))


def weights(path: Path) -> None:
    """Make one weight NaN."""
    tensors = load_file(path)
    name = next(name for name, tensor in tensors.items() if tensor.is_floating_point())
    tensors[name].view(-1)[0] = float("nan")
    save_file(tensors, path)


def program(path: Path) -> None:
    """Name a program as a processor step."""
    content = json.loads(path.read_text())
    content["steps"].append(
        {"class": "subprocess.Popen", "config": {"args": ["touch", str(path.parent / "ran")]}}
    )
    path.write_text(json.dumps(content))


def pickled(path: Path) -> None:
    """Exchange the weights for pickled ones."""
    path.rename(path.with_name("pytorch_model.bin"))


def foreign(name: str) -> Callable[[Path], None]:
    """Give a configuration a field that no version has."""

    def damage(path: Path) -> None:
        content = json.loads(path.read_text())
        path.write_text(json.dumps({**content, name: 1}))

    return damage
