"""Items to the workers of a Dask cluster, as many at a time as there are workers, and their outcomes back."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from visfuse_cli.apps.batch.manifest import Item
from visfuse_cli.apps.batch.work import ItemFailed, Outcome, perform
from visfuse_cli.errors import InputError, UsageError

if TYPE_CHECKING:
    from distributed import Client, Future

HUSH = "ignore::UserWarning:multiprocessing.resource_tracker"  # what it says of a worker that was killed
POLL_S = 0.5  # how long a stop request waits to be seen
WAIT_S = 30.0  # for a scheduler, and for its first worker


@contextmanager
def connected(workers: int, scheduler: str | None) -> Iterator[Client]:
    """A client of the cluster at an address, or of `workers` processes of our own that end with the block.

    Raises UsageError where Dask is not installed, InputError where nobody answers at the address or works there.
    """
    try:
        import cryptography  # noqa: F401  (the local cluster talks over TLS: nobody else on the machine gives it work)
        import dask
        import threadpoolctl  # noqa: F401
        from distributed import Client, LocalCluster, Security
    except ImportError as problem:
        raise UsageError(f"batch needs {problem.name}: pip install 'visfuse-cli[batch]'") from problem
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        if scheduler is not None:
            client = stack.enter_context(_reached(Client, scheduler))
        else:
            os.environ.setdefault("PYTHONWARNINGS", HUSH)
            scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="visfuse-batch-"))
            stack.enter_context(dask.config.set({"distributed.worker.memory.terminate": False}))
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                protocol="tls://",
                security=Security.temporary(),
                dashboard_address=None,
                silence_logs=logging.CRITICAL,
                memory_limit=0,
                local_directory=scratch,
            )
            client = stack.enter_context(Client(stack.enter_context(cluster)))
        yield client


def _reached(connect: Callable[..., Client], address: str) -> Client:
    try:
        client = connect(address, timeout=WAIT_S)
    except (OSError, ValueError, TypeError) as problem:
        raise InputError(f"--scheduler {address}: no scheduler answers there: {problem}") from problem
    try:
        client.wait_for_workers(1, timeout=WAIT_S)
    except TimeoutError as problem:
        client.close()
        raise InputError(f"--scheduler {address}: it has no workers; start some with `dask worker`") from problem
    return client


def outcomes(
    client: Client, items: Sequence[Item], threads: int, keep_going: bool, stopped: Callable[[], bool]
) -> Iterator[Outcome]:
    """The outcome of each item as it ends; after a stop nothing more, after a failure only what is under way.

    An item whose worker dies goes to another one; the cluster itself sees to that.
    """
    from distributed import wait

    waiting = list(reversed(items))
    running: dict[Future, Item] = {}
    while (waiting or running) and not stopped():
        while waiting and len(running) < max(sum(client.nthreads().values()), 1):
            item = waiting.pop()
            future = client.submit(perform, item, threads, key=item.name, pure=False, retries=item.retries)
            running[future] = item
        try:
            ended = wait(list(running), timeout=POLL_S, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            continue
        for future in ended:
            outcome = _outcome(future, running.pop(future))
            if outcome.code and not keep_going:
                waiting = []
            yield outcome


def _outcome(future: Any, item: Item) -> Outcome:
    problem = future.exception()
    if problem is None:
        found: Outcome = future.result()
        return found
    if isinstance(problem, ItemFailed):
        return problem.outcome
    # Not the item's own failure: its workers died one after another, or the cluster has no visfuse.
    return Outcome(item.name, "lost", 1, message=f"{type(problem).__name__}: {' '.join(str(problem).split())}")
