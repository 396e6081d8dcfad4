"""Jobs of a cluster, by submitit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.studies.jobs import Executor


def cluster_executor(cluster: str, folder: Path, options: Mapping[str, int | str]) -> Executor:
    """Submitit's executor for a cluster; `local` makes processes on this machine.

    Args:
        cluster: as submitit names it, such as slurm.
        folder: where it keeps its files; one that all machines see.
        options: what submitit's `update_parameters` takes, such as timeout_min.

    Raises:
        FlagError: if submitit is not installed or does not know an option.
    """
    try:
        import submitit
    except ImportError as error:
        raise FlagError(
            f"--executor={cluster} needs submitit: pip install 'lerobot_policy_agpd[cluster]'"
        ) from error
    executor = submitit.AutoExecutor(folder, cluster=cluster)
    try:
        executor.update_parameters(**options)
    except (NameError, TypeError, ValueError) as error:
        raise FlagError(f"--executor_options={dict(options)}: {error}") from error
    return executor
