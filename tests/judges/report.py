"""Named checks. Each check names its assertion, and checks after a failed one still run."""

import time


class Stop(Exception):
    """The remaining checks of the section cannot run."""


class Report:
    def __init__(self):
        self.passed = 0
        self.failed = []
        self._section = ""
        self._start = time.monotonic()

    def section(self, name):
        self._section = name
        print(f"\n== {name} ({time.monotonic() - self._start:.1f} s)", flush=True)

    def note(self, text):
        print(f"     {text}", flush=True)

    def check(self, name, ok, detail=""):
        """Asserts `ok`. `detail` explains a failure, or gives the result of a passed check."""
        if ok:
            self.passed += 1
        else:
            self.failed.append(f"{self._section}: {name}: {detail}")
        print(f"{'ok  ' if ok else 'FAIL'} {name}{f': {detail}' if detail != '' else ''}", flush=True)
        return bool(ok)

    def equal(self, name, got, expected, show=str):
        if got == expected:
            return self.check(name, True, show(got))
        return self.check(name, False, f"{show(got)}, not {show(expected)}")

    def need(self, name, ok, detail=""):
        """A check that the rest of the section requires."""
        if not self.check(name, ok, detail):
            raise Stop(name)

    def mark(self):
        """The checks so far."""
        return self.passed, len(self.failed)

    def well_since(self, mark):
        return len(self.failed) == mark[1]

    def forget(self, mark):
        """Discards the checks since `mark`."""
        self.passed = mark[0]
        del self.failed[mark[1] :]

    def finish(self):
        """The exit code."""
        print(f"\n{self.passed} checks passed, {len(self.failed)} failed")
        for failure in self.failed:
            print(f"  {failure}")
        return 1 if self.failed else 0
