"""Children and the signals that they find ignored."""

import contextlib
import signal


@contextlib.contextmanager
def begins(ignored=()):
    """A child that is started within ignores these, and neither SIGINT nor SIGTERM otherwise.

    In the background of a script SIGINT is ignored, and that is inherited. `preexec_fn` would fork
    this process, of which JAX warns.
    """
    before = {number: signal.signal(number, signal.SIG_IGN if number in ignored else signal.SIG_DFL)
              for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
