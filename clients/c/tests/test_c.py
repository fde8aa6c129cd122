"""The client in C against `ecaxis serve` and against hostile servers. `ECAXIS` names the program.

Everything is compiled with the sanitizers for addresses and undefined behaviour, by each compiler that is there."""

import os
import pathlib
import re
import shutil
import subprocess

import ecaxis
import pytest

import hostile

ROOT = pathlib.Path(__file__).resolve().parents[3]
HERE = ROOT / "clients/c"
SQUARE = ROOT / "configs/square.toml"
FLAGS = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-pedantic", "-g", "-O1", f"-I{HERE}"]
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
REPORTED = 99


def has_sanitizers(compiler):
    """True if a compiler is here with its sanitizers, which Debian has in a package of their own."""
    command = [compiler, "-x", "c", *SANITIZERS, "-", "-o", "/dev/null"]
    return shutil.which(compiler) and subprocess.run(command, input=b"int main(void) {}", capture_output=True).returncode == 0


COMPILERS = [name for name in ("gcc", "clang") if has_sanitizers(name)]
assert COMPILERS, "neither gcc nor clang is here with its sanitizers"


def environment():
    return {**os.environ, "ASAN_OPTIONS": f"exitcode={REPORTED}", "UBSAN_OPTIONS": f"exitcode={REPORTED}"}


def build(*command):
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"


@pytest.fixture(scope="session", params=COMPILERS)
def programs(request, tmp_path_factory):
    """The examples, the snippets of the README and `exercise`, by one compiler."""
    folder, compiler = tmp_path_factory.mktemp(request.param), [request.param, *FLAGS, *SANITIZERS]
    snippets = re.findall(r"```c\n(.*?)```", (HERE / "README.md").read_text(), re.S)
    assert len(snippets) == 3
    sources = {"exercise": HERE / "tests/exercise.c"}
    sources.update((name, HERE / f"examples/{name}.c") for name in ("sine", "square"))
    for number, text in enumerate(snippets):
        sources[f"snippet {number}"] = folder / f"snippet{number}.c"
        sources[f"snippet {number}"].write_text(text)
    build(*compiler, "-c", HERE / "ecaxis.c", "-o", folder / "ecaxis.o")
    for source in sources.values():
        build(*compiler, source, folder / "ecaxis.o", "-lm", "-o", folder / source.stem)
    return {name: folder / source.stem for name, source in sources.items()}


def run(program, path, *arguments, timeout=60):
    command = [str(program), str(path), *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=timeout)


def free_machine(**options):
    """A server whose motion has no owner."""
    machine = ecaxis.open(options.pop("file", ROOT / "configs/demo.toml"), **options)
    machine.release()
    return machine


@pytest.mark.parametrize("number", range(3))
def test_snippets_of_the_readme_run(programs, number):
    with free_machine(sim=True) as machine:
        done = run(programs[f"snippet {number}"], machine._path)
        assert done.returncode == 0, done.stderr
        errors = done.stderr.strip()
        assert errors == "" or number == 1 and re.fullmatch(r"x: move: .*outside the range.* \(refused\)(\nhelp: .*)?", errors)
        if number == 0:
            assert re.fullmatch(r"(19\.9\d|20\.0\d), Operation enabled\n", done.stdout)


def test_the_square_is_moved_and_a_fault_is_reset(programs, tmp_path):
    faults = tmp_path / "faults.toml"
    faults.write_text('[[fault]]\nkind = "drive-fault"\ndevice = 0\nat = "5s"\ncode = 0x4210\n')
    with free_machine(file=SQUARE, virtual=True, faults=faults) as machine:
        done = run(programs["square"], machine._path, "4")
        assert done.returncode == 0, done.stdout + done.stderr
        lines = done.stdout.splitlines()
        assert lines[:2] == ["homed", "clamped"] and lines[-1] == "square 4"
        assert sum(line.startswith("fault of x: drive fault") for line in lines) == 1
        assert abs(machine.x.position) < 0.05 and abs(machine.y.position) < 0.05 and not machine.x.enabled


def test_every_function_runs_and_errors_say_why(programs):
    with free_machine(file=SQUARE, virtual=True) as machine:
        done = run(programs["exercise"], machine._path)
        assert done.returncode == 0, done.stderr
        assert "axes 2, x is 0" in done.stdout and "x -60\n" in done.stdout
        for text in (
            'a "strange" \\ name\n: home: no axis is called',
            "x: move: `to` is not a finite number (bad_request)",
            "x: move: `speed` is not a finite number",
            "wait: no request has the number 0",
        ):
            assert text in done.stderr, done.stderr


def test_numbers_have_a_point_in_every_locale(programs, tmp_path):
    command = ["localedef", "-i", "de_DE", "-f", "UTF-8", str(tmp_path / "de_DE.UTF-8")]
    if not shutil.which("localedef") or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("no locale with a comma can be made")
    comma = {**environment(), "LOCPATH": str(tmp_path), "LC_ALL": "de_DE.UTF-8"}
    with free_machine(file=SQUARE, sim=True) as machine:
        done = subprocess.run([str(programs["exercise"]), machine._path], capture_output=True, text=True, env=comma)
        assert done.returncode == 0 and "area 0,001 " in done.stdout and "x -60\n" in done.stdout, done.stdout + done.stderr
        assert "not JSON" not in done.stderr


def test_one_client_owns_the_motion(programs):
    with ecaxis.open(SQUARE, sim=True) as machine:
        done = run(programs["square"], machine._path)
        assert done.returncode == 1
        assert re.search(r"take: `.*` owns the motion \(not_owner\)\nhelp: .*force", done.stderr), done.stderr
    done = run(programs["square"], machine._path)
    assert done.returncode == 1
    assert re.search(r"attach: cannot connect to .*: No such file .* \(lost\)\nhelp: start `ecaxis serve`", done.stderr)


def test_set_points_are_used_in_every_cycle(programs):
    with free_machine(sim=True) as machine:
        done = run(programs["sine"], machine._path, "2")
        used, late, refused = map(int, re.search(r"used (\d+) late (\d+) refused (\d+)", done.stdout).groups())
        print(f"used {used}, late {late}")
        # A computer that stands still for ten cycles stops the axis, which is not an error of the client.
        assert refused == 0 and used > 0
        assert done.returncode == 0 or "came too late" in done.stderr


def test_a_server_that_ends_is_reported(programs):
    with free_machine(file=SQUARE, sim=True) as machine:
        command = [str(programs["square"]), machine._path, "100"]
        child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment())
        assert child.stdout.readline() == "homed\n"
        machine._server.process.kill()
        _, errors = child.communicate(timeout=30)
        assert child.returncode == 1 and "(lost)\nhelp: attach again" in errors, errors


@pytest.mark.parametrize("name", sorted(hostile.SERVERS))
def test_a_hostile_server_does_no_harm(programs, tmp_path, name):
    with hostile.serve(tmp_path / "s.sock", hostile.SERVERS[name]):
        done = run(programs["exercise"], tmp_path / "s.sock")
    assert done.returncode in (0, 1), f"{done.returncode} {done.stderr}"
    if name.startswith("area"):
        assert "area: the shared memory of the server has another layout (protocol)" in done.stderr or name == "area: good"
        assert ("area 0.001" in done.stdout) == (name == "area: good"), done.stdout + done.stderr


def test_changed_answers_do_no_harm(programs, tmp_path):
    rounds = int(os.environ.get("ECAXIS_FUZZ_FRAMES", 60))
    for seed in range(rounds):
        with hostile.serve(tmp_path / "s.sock", hostile.changed(seed)):
            done = run(programs["exercise"], tmp_path / "s.sock")
        assert done.returncode in (0, 1), f"seed {seed}: {done.returncode} {done.stderr}"


def test_cmake_installs_a_package(tmp_path):
    if not shutil.which("cmake"):
        pytest.skip("cmake is not here")
    prefix, user = tmp_path / "prefix", tmp_path / "user"
    build("cmake", "-S", HERE, "-B", tmp_path / "build", f"-DCMAKE_INSTALL_PREFIX={prefix}", "-DCMAKE_INSTALL_LIBDIR=lib")
    build("cmake", "--build", tmp_path / "build")
    build("cmake", "--install", tmp_path / "build")
    user.mkdir()
    shutil.copy(HERE / "examples/sine.c", user / "main.c")
    (user / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(user C)\nfind_package(ecaxis REQUIRED)\n"
        "add_executable(user main.c)\ntarget_link_libraries(user ecaxis::ecaxis m)\n"
    )
    build("cmake", "-S", user, "-B", user / "build", f"-DCMAKE_PREFIX_PATH={prefix}")
    build("cmake", "--build", user / "build")
    if not shutil.which("pkg-config"):
        pytest.skip("pkg-config is not here")
    paths = {**os.environ, "PKG_CONFIG_PATH": str(prefix / "lib/pkgconfig")}
    flags = subprocess.run(["pkg-config", "--cflags", "--libs", "ecaxis"], capture_output=True, text=True, env=paths, check=True)
    build(COMPILERS[0], user / "main.c", *flags.stdout.split(), "-lm", "-o", tmp_path / "linked")
