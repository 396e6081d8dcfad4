"""What the commands share: how they start, and how they end where the user can put it right."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from draccus.utils import DraccusException
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_agpd.comparison.matrix import reason

logger = logging.getLogger(__name__)

WRONG_INPUT = (ValueError, FileNotFoundError, FileExistsError, ModuleNotFoundError)


@contextmanager
def command(name: str) -> Iterator[None]:
    """Logging and plugins are set up; wrong input ends the command with one line instead of a traceback.

    Args:
        name: of the command, as the line begins.
    """
    init_logging()
    register_third_party_plugins()
    try:
        yield
    except DraccusException as error:  # hides what a `__post_init__` says
        sys.exit(f"{name}: {reason(error)}")
    except WRONG_INPUT as error:
        logger.debug("the traceback:", exc_info=True)
        sys.exit(f"{name}: {error}")
