"""Progress of a training: one that shows nothing, and one that ends the training at a step."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from mien.progress import Advance


@contextmanager
def silence(title: str, total: int, completed: int) -> Iterator[Advance]:
    yield lambda amount=1, status="": None


def stopped_at(
    step: int, error: type[BaseException] = KeyboardInterrupt
) -> Callable[[str, int, int], AbstractContextManager[Advance]]:
    """Return a progress that raises an error after a step, by default that of Ctrl-C."""

    @contextmanager
    def progress(title: str, total: int, completed: int) -> Iterator[Advance]:
        done = completed

        def advance(amount: int = 1, status: str = "") -> None:
            nonlocal done
            done += amount
            if done == step:
                raise error

        yield advance

    return progress
