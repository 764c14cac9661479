"""Readers that fail in the ways in which a library fails on a damaged file; they run in a process of their own."""

import ctypes
import os
import time


def counting(path, n):
    yield from range(n)


def allocate(path):
    yield bytearray(2**32)


def folder(path):
    yield os.getcwd()


def pid_then(path, function):
    """The process's id, then whatever `function` does."""
    yield os.getpid()
    function()


def abort():
    os.abort()


def leave():
    os._exit(3)


def hang():
    """For ever, and no thread of Python can run meanwhile: PyDLL keeps the interpreter's lock."""
    ctypes.PyDLL(None).pause()


def computing(path):
    """The process's processor time, s; then it computes for ever."""
    yield time.process_time()
    while True:
        pass


def shout():
    os.write(1, b"a library prints what nobody asked for\n" * 100)
    print("and so", flush=True)


def fail():
    raise SystemExit("a library wants to leave")


def frames_then_abort(path, wanted, longest):
    """A log's reader that dies after its first frames."""
    from sources.can.readers import read_messages

    yield next(read_messages(path, wanted, longest))
    os.abort()


def abort_at_once(path, *args):
    os.abort()
    yield
