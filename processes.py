"""Runs the training loop in one process or in one a core, and ends it well.

Ctrl-C and SIGTERM let the loop save and end. What a user can mend (a full disk, a checkpoint that does not fit) is said in
one line. If a process dies, so do the others: they would wait for it for ever. Exit codes: 2 for wrong input, 1 for the rest
(3, within a run, for a process that has lost another).
"""

import multiprocessing as mp
import os
import signal
import sys
import tempfile
from multiprocessing.connection import wait

from checkpoint import CheckpointError

SIGNALS = (signal.SIGINT, signal.SIGTERM)
LOST = 3  # exit code of a process that has lost another one


def run(train, args) -> None:
    """train(rank, args, sync, stop) for every rank below `args.processes`.

    sync: where the processes find each other (torch.distributed's init_method). stop: a list, no longer empty when the
    loop has to end.
    """
    if "RANK" in os.environ:  # started by torchrun, which has made the processes
        guarded(train, int(os.environ["RANK"]), args, "env://")
    elif args.processes == 1:
        guarded(train, 0, args)
    else:
        in_processes(train, args)


def guarded(train, rank: int, args, sync: str | None = None, told=None) -> None:
    """`train`, with its errors in one line.

    told: a lock that the first of several processes with something to say takes; the others' troubles follow from it.
    """
    stop = []
    former = {number: signal.signal(number, lambda *_: stop.append(True)) for number in SIGNALS}
    try:
        return train(rank, args, sync, stop)
    except SystemExit:
        if told is not None:
            told.acquire(block=False)  # it has said why
        raise
    except CheckpointError as error:
        code, says = 2, error
    except FloatingPointError as error:  # --resume would come to the same point again, to the bit
        code, says = 1, f"{error}: start anew with another --seed, or with another learning rate in PPOConfig"
    except OSError as error:
        code, says = 1, f"{error}{last_saved(args)}"
    except (MemoryError, RuntimeError) as error:
        lost = "gloo" in str(error) or "NCCL" in str(error)
        if lost and told is not None:  # another process has ended, and the one that started us says so
            os._exit(LOST)
        if lost:
            code, says = LOST, f"another process of this run has ended{last_saved(args)}"
        elif isinstance(error, MemoryError) or "allocate" in str(error):  # torch's word for too little memory
            code, says = 1, f"there is not enough memory for {args.envs} robots: choose fewer with --envs"
        else:
            raise
    finally:
        if told is None:
            for number, handler in former.items():
                signal.signal(number, handler)
    if told is None or told.acquire(block=False):
        print("\n" * sys.stdout.isatty() + f"error: {' '.join(str(says).split())}", file=sys.stderr, flush=True)
    if args.processes > 1:
        os._exit(code)  # at once: the others wait for this process
    sys.exit(code)


def in_processes(train, args) -> None:
    """A process a rank. This one passes Ctrl-C and SIGTERM on to them, and ends all if one has ended early."""
    context = mp.get_context("spawn")
    told = context.Lock()
    former = {number: signal.getsignal(number) for number in SIGNALS}
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # inherited: a process that is still starting would answer with a traceback
    with tempfile.TemporaryDirectory() as folder:
        sync = f"file://{folder}/sync"
        processes = [context.Process(target=guarded, args=(train, i, args, sync, told)) for i in range(args.processes)]
        for process in processes:
            process.start()
        for number in SIGNALS:
            signal.signal(number, lambda *_: [process.terminate() for process in processes])
        codes = [None] * args.processes
        while None in codes and not any(codes):
            wait([process.sentinel for process, code in zip(processes, codes) if code is None])
            codes = [process.exitcode for process in processes]
        for process in processes:
            process.join(1)  # what has lost another one ends by itself
        codes = [process.exitcode for process in processes]
        for process in processes:
            process.kill()
            process.join()
    for number, handler in former.items():
        signal.signal(number, handler)
    if any(codes):
        code = next((code for code in codes if code not in (None, 0, LOST)), LOST)
        if told.acquire(block=False):  # nobody has said why
            how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            print(f"error: a process of the training was ended by {how}{last_saved(args)}", file=sys.stderr)
        sys.exit(code if code > 0 else 1)


def orphaned() -> bool:
    """Has the process that started this one been killed?"""
    parent = mp.parent_process()
    return parent is not None and not parent.is_alive()


def last_saved(args) -> str:
    return f"; --resume goes on from the last checkpoint in {args.out}" if (args.out / "checkpoint.pt").exists() else ""
