"""Commands of ``triline`` in this process, and what they say."""

from __future__ import annotations

import json
import signal
from typing import Any

import pytest

from triline.nodes.cli import main

Capture = pytest.CaptureFixture[str]


def run(capsys: Capture, *words: object) -> tuple[int, str, str]:
    """Exit code, standard output, standard error; signals are handled as before."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        code = main([str(word) for word in words])
    except SystemExit as exit_:
        code = int(exit_.code or 0)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    out, err = capsys.readouterr()
    assert "Traceback" not in err and "fault in triline" not in err, err
    return code, out, err


def answer(capsys: Capture, *words: object) -> Any:
    """What a command with ``--json`` says."""
    capsys.readouterr()
    code, out, err = run(capsys, *words, "--json")
    assert code == 0, err
    return json.loads(out)


def refusal(capsys: Capture, *words: object) -> str:
    """The line in which a command says why it does nothing."""
    capsys.readouterr()
    code, out, err = run(capsys, *words)
    assert code == 1 and out == "" and err.count("\n") == 1 and err.startswith(f"triline {words[0]}: "), err
    return err
