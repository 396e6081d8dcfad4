"""A progress bar for commands that write episodes."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


@contextmanager
def episode_bar(description: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show a progress bar; yields a function that advances it by a number of episodes.

    Args:
        description: shown beside the bar.
        total: number of episodes.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns) as progress:
        bar = progress.add_task(description, total=total)
        yield lambda n_episodes: progress.advance(bar, n_episodes)
