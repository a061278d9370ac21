"""The `zestjax` command: parses, calls `zestjax.apps`, and turns errors into one line and an exit code.

Exit codes: 0 done; 2 bad arguments or bad input, one line on standard error that starts with `error:`; 75 (`crossval`)
not all has ended, run it again; 1 anything else.
Progress goes to standard error, one summary line to standard output; with --quiet, neither.
"""

import errno
import io
import shlex
import sys
import warnings

from zestjax.apps.commands import parser


def main(arguments=None):
    """Run one command; returns the exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # paths are printed whatever letters they have
    given = sys.argv[1:] if arguments is None else arguments
    options = vars(parser().parse_args(given))
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _said_nothing if options["quiet"] else _warned
            return _run(options, given)
    except KeyboardInterrupt:
        return _failed("interrupted", 1)
    except OSError as error:
        return _failed(_os_error(error), 2)
    except (MemoryError, RecursionError) as error:
        return _failed(f"{_one_line(error) or type(error).__name__}: the input is too large or nested too deeply", 2)
    except (ValueError, FloatingPointError) as error:
        return _failed(_one_line(error), 2)
    except RuntimeError as error:
        if not _of_the_machine(error):
            raise
        return _failed(_one_line(error), 1)


def _run(options, given):
    """The exit code of a command whose flags are read; `given`: the command line, to be told when it can go on."""
    run, quiet = options.pop("run"), options["quiet"]
    _check_out(options)
    _prepare_jax()
    line, finished = run(options)
    if not finished and "resume" in options:
        again = [*given, *["--resume"] * (not options["resume"])]
        line = f"{line}; go on with: {shlex.join(['zestjax', *again])}"
    if not quiet:
        print(line, flush=True)
    return 0 if finished is True else finished or 1


def _check_out(options):
    """Refuse a place that cannot be written to before any work is done for it."""
    from zestjax.io.files import check_writable

    out = options.get("out")
    if out is None:
        return
    if options.pop("out_is_file", False):
        if out.is_dir():
            raise ValueError(f"{out}: is a folder; give the file to write.")
        out = out.parent
    check_writable(out)


def _warned(message, *_, **__):
    print(f"warning: {_one_line(message)}", file=sys.stderr)


def _said_nothing(*_, **__):
    pass


def _failed(text, code):
    print(f"error: {text}", file=sys.stderr)
    return code


def _one_line(error):
    return " ".join(str(error).split())


def _os_error(error):
    from zestjax.io.files import WriteError, remedy

    where = f"{error.filename}: " if error.filename else ""
    known = isinstance(error, WriteError) or error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
    return f"{where}{error.strerror or error}{'' if known else f'; {remedy(error.errno)}'}"


def _of_the_machine(error):
    """Whether an error tells of memory or of a process that ended, not of a fault in the program."""
    import jax

    from zestjax.apps.producer import ProducerError

    return isinstance(error, (ProducerError, jax.errors.JaxRuntimeError))


def _prepare_jax():
    """Compiled programs are kept in the user's cache folder, so that a command compiles once."""
    from zestjax.apps.cache import keep_compiled

    keep_compiled()


if __name__ == "__main__":
    sys.exit(main())
