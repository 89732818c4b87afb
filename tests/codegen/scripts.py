"""Compilers that are shell scripts: they count their calls, fail, hang or lie."""

import os
import shutil

import pytest

CC = shutil.which("cc")
RIGHT = f'exec "{CC}" "$@"'
needed = pytest.mark.skipif(
    CC is None or os.name != "posix", reason="there is no C compiler, or none that is a script"
)


class Script:
    """A compiler whose body is in the environment: the same one for the cache, whatever it does."""

    def __init__(self, folder, monkeypatch, name="cc"):
        self.path, self.log, self.monkeypatch = folder / name, folder / "calls", monkeypatch
        if not self.path.exists():
            self.path.write_text('#!/bin/sh\necho "$*" >> "$COMPILER_LOG"\neval "$COMPILER_BODY"\n')
            self.path.chmod(0o755)
        self.log.unlink(missing_ok=True)
        monkeypatch.setenv("COMPILER_LOG", str(self.log))
        self.does(RIGHT)

    def does(self, body, arguments=""):
        """Have it do this, and be named with these arguments."""
        self.monkeypatch.setenv("COMPILER_BODY", body)
        self.monkeypatch.setenv("CC", f"'{self.path}' {arguments}".strip())

    def lies(self, edit, levels):
        """Have it compile another text at some levels of optimisation."""
        cases = "|".join(f"*'{level}'*" for level in levels)
        self.does(
            f"case \"$*\" in {cases})\n"
            "for source; do case \"$source\" in *.c) break;; esac; done\n"
            f"cp \"$source\" \"$source.true\"\nsed '{edit}' \"$source.true\" > \"$source\"\n"
            "cmp -s \"$source\" \"$source.true\" && { echo 'no lie' >&2; exit 1; }\n;; esac\n"
            f"{RIGHT}"
        )

    @property
    def calls(self):
        return self.log.read_text().splitlines() if self.log.exists() else []
