"""The command line. Nothing heavy is imported here, so that help comes at once."""

import argparse
import importlib
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from dtprob import __version__
from dtprob.case import load_case
from dtprob.commands.progress import unread
from dtprob.errors import InputError, nearest, raised_at
from dtprob.files import let_go
from dtprob.reproduce import FIGURES
from dtprob.sections import read_document
from dtprob.stopping import Stopping
from dtprob.threads import one_thread
from dtprob.xla import avoid_miscompilation

DONE, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130

COMMANDS = {
    "demo": "dtprob.commands.demo",
    "fit": "dtprob.commands.fit",
    "diagnose": "dtprob.commands.diagnose",
    "twin": "dtprob.commands.twin",
    "reproduce": "dtprob.commands.reproduce",
    "withheld": "dtprob.commands.withheld",
    "list": "dtprob.commands.listing",
    "doctor": "dtprob.commands.doctor",
}
"""For each command, the module whose `run`, or the function of the subcommand's name, does it."""

_GOES_ON = "Continue with the same command and --resume."
_RESUMED = {
    "diagnose": "With --resume the same command takes what was traced and learned from reference data, and begins anew."
}
"""What --resume does after a command was stopped, where it does not go on from there."""


class Parser(argparse.ArgumentParser):
    """Answers a mistake with one line that says what to do; `--debug` goes wherever `--help` does."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Like those of `argparse.ArgumentParser`."""
        super().__init__(*args, **kwargs)
        # without a default, since that of a step would undo what was said before it
        self.add_argument(
            "--debug",
            action="store_true",
            default=argparse.SUPPRESS,
            help="show the traceback of an error",
        )

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, the nearest valid word or where to look, and leave with status 2."""
        remedy = self._guess(message) or f"See `{self.prog} --help`."
        sys.stderr.write(f"dtprob: {message}. {remedy}\n")
        raise SystemExit(WRONG_INPUT)

    def _guess(self, message: str) -> str | None:
        """Ask for the valid word nearest to a wrong one."""
        if "invalid choice: " in message:
            wrong = message.split("'")[1]
        elif "unrecognized arguments: " in message:
            wrong = message.split("arguments: ")[1].split(maxsplit=1)[0]
        else:
            return None
        known: list[str] = []
        for action in self._actions:
            known += [*action.option_strings, *(action.choices or ())]
        close = nearest(wrong, known)
        return f"Did you mean '{close}'?" if close else None


def parser() -> Parser:
    """The grammar of the command line."""
    top = Parser(
        prog="dtprob",
        description="Digital twins of wireless systems: fit a twin to data, and find out why they differ.",
        epilog="Exit status: 0 done, 1 the job failed, 2 wrong input.",
    )
    top.add_argument("--version", action="version", version=f"dtprob {__version__}")
    commands = top.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)

    def add(name: str, text: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")

    _add_out(add("demo", "diagnose recorded measurements, without any set-up: report.html"))
    _add_case(add("fit", "infer a twin's parameters from data: posterior.nc, summary.json"))
    _add_case(add("diagnose", "find out why data differ from a twin: report.html, report.json, gap.nc"))
    _add_twin(add("twin", "run a network's twin against its physical twin, phase after phase: history.json"))
    figure = add("reproduce", "make a figure of the seed report: FIGURE.json, FIGURE.png")
    figure.add_argument("figure", choices=tuple(FIGURES), metavar="FIGURE", help=", ".join(FIGURES))
    _add_out(figure)
    figure.add_argument("--runs", type=int, metavar="N", help="runs, instead of the figure's own number")
    figure.add_argument("--seed", type=int, default=0, metavar="S", help="where randomness starts")
    figure.add_argument("--resume", action="store_true", help="continue an interrupted run in the same DIR")
    _add_withheld(add("withheld", "how good diagnoses are: cases whose cause is kept apart, and their score"))
    listing = add("list", "what there is to choose from")
    listing.add_argument("what", choices=("models", "engines", "effects"))
    listing.add_argument("--json", action="store_true", help="as JSON")
    doctor = add("doctor", "what this machine can do, and how to get what is missing")
    doctor.add_argument("--json", action="store_true", help="as JSON")
    return top


def _add_out(added: argparse.ArgumentParser) -> None:
    added.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")


def _add_case(added: argparse.ArgumentParser) -> None:
    added.add_argument("case", type=Path, metavar="CASE", help="TOML file that names model, data, engine")
    _add_out(added)
    added.add_argument("--engine", metavar="NAME", help="inference engine, instead of the case's")
    added.add_argument("--seed", type=int, metavar="S", help="seed, instead of the case's")
    added.add_argument("--no-code", action="store_true", help="refuse a case that runs code of its own")
    added.add_argument("--resume", action="store_true", help="continue an interrupted run in the same DIR")


def _add_twin(added: argparse.ArgumentParser) -> None:
    parts = added.add_subparsers(metavar="STEP", dest="step", required=True)
    run = parts.add_parser("run", help="collect, learn, control, monitor, diagnose, and collect again")
    run.add_argument("twin_case", type=Path, metavar="CASE", help="TOML file of model and physical twin")
    _add_out(run)
    run.add_argument("--seed", type=int, metavar="S", help="seed, instead of the case's")
    run.add_argument("--no-code", action="store_true", help="refuse a case that runs code of its own")
    run.add_argument("--resume", action="store_true", help="continue an interrupted run in the same DIR")


def _add_withheld(added: argparse.ArgumentParser) -> None:
    parts = added.add_subparsers(metavar="STEP", dest="step", required=True)
    generate = parts.add_parser("generate", help="make cases/NNNN/ and, apart from them, key.json")
    generate.add_argument(
        "--track", required=True, metavar="TRACK", help="kind of twin: channel, network, labels or custom"
    )
    generate.add_argument("--count", type=int, required=True, metavar="N", help="number of cases")
    generate.add_argument("--seed", type=int, default=0, metavar="S", help="where randomness starts")
    _add_out(generate)
    kinds = ("null", "listed", "unlisted", "pair")
    generate.add_argument("--kinds", nargs="+", default=kinds, metavar="KIND", help="kinds of cases in turn")
    sizes = (25.0, 100.0, 400.0)
    generate.add_argument(
        "--lambdas", nargs="+", type=float, default=sizes, metavar="L", help="information of each effect"
    )
    run = parts.add_parser("run", help="diagnose CASES/NAME/case.toml into OUT/NAME/report.json")
    run.add_argument("cases", type=Path, metavar="CASES", help="folder of the cases")
    run.add_argument("--out", type=Path, required=True, metavar="ANSWERS", help="folder of the answers")
    run.add_argument("--workers", type=int, default=1, metavar="N", help="processes at work")
    run.add_argument("--seed", type=int, metavar="S", help="seed, instead of the cases'")
    run.add_argument("--no-code", action="store_true", help="refuse cases that run code of their own")
    run.add_argument("--rivals", action="store_true", help="let other methods answer too, into rivals.json")
    run.add_argument("--resume", action="store_true", help="keep the answers that are there")
    score = parts.add_parser("score", help="compare answers with their key: score.json, score.html")
    score.add_argument("answers", type=Path, metavar="ANSWERS", help="folder of the answers")
    score.add_argument("--key", type=Path, required=True, metavar="FILE", help="the cases' key.json")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: the words after ``dtprob``; by default those of this process.

    Returns:
        the exit status: 0 done, 1 the job failed, 2 wrong input, 130 stopped by Ctrl-C.
    """
    options = vars(parser().parse_args(arguments))
    command, step, debug = options.pop("command"), options.pop("step", "run"), options.pop("debug", False)
    avoid_miscompilation()
    one_thread()
    with Stopping() as stopping:
        try:
            return _run(command, step, options, stopping, debug=debug)
        except KeyboardInterrupt:
            resume = f" {_RESUMED.get(command, _GOES_ON)}" if "resume" in options else ""
            return _fail(INTERRUPTED, f"stopped.{resume}", debug=debug)
        finally:
            let_go()


def _run(command: str, step: str, options: dict[str, Any], stopping: Stopping, *, debug: bool) -> int:
    """Run a command, and make one line of what goes wrong."""
    try:
        if "case" in options:  # before anything heavy, so that a mistake in it shows at once
            options["case"] = load_case(options["case"])
        if "twin_case" in options:
            read_document(options["twin_case"])
        getattr(importlib.import_module(COMMANDS[command]), step)(**options)
    except BrokenPipeError:
        unread()
    except Exception as error:  # noqa: BLE001  (the one place where any failure becomes one line)
        if stopping.asked is not None:  # what the signal raised was made something else of
            stopping.again()
        if isinstance(error, InputError):
            return _fail(WRONG_INPUT, str(error), debug=debug)
        text = f"{command} failed: {type(error).__name__}: {str(error) or 'no message'}".rstrip(".")
        place = f" (in {where})" if (where := raised_at(error)) else ""
        return _fail(FAILED, f"{text}{place}. See how it came there with --debug.", debug=debug)
    return DONE


def _fail(status: int, text: str, *, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    sys.stderr.write(f"dtprob: {' '.join(text.split())}\n")
    return status


if __name__ == "__main__":
    sys.exit(main())
