//! The binary from the user's view: exit codes and messages that name the problem.

use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::program::{self, Ran, run};
use ecaxis_test_support::{assert_contains, axes, root};

/// Runs `check` or `run` on a machine file with the given text.
fn with_file(verb: &str, text: &str, more: &[&str]) -> Ran {
    let bench = Bench::new();
    bench.write("machine.toml", text);
    bench.ecaxis(&[&[verb, "machine.toml"], more].concat())
}

#[test]
fn check_rejects_an_unknown_key() {
    let text = axes(1).replace("cycle =", "cicle =");
    with_file("check", &text, &[]).fails(
        2,
        &["unknown key `cicle`", "did you mean `cycle`?", "^^^^^"],
    );
}

#[test]
fn check_rejects_a_misspelt_unit_of_time() {
    let text = axes(1).replace("\"1ms\"", "\"1mss\"");
    with_file("check", &text, &[]).fails(2, &["unknown unit of time `mss`", "did you mean `ms`?"]);
}

#[test]
fn check_rejects_a_missing_esi_file() {
    let text = axes(1).replace("esi/EPOS4.xml", "esi/EPOS5.xml");
    let parts = ["cannot read esi/EPOS5.xml", "did you mean `EPOS4.xml`?"];
    with_file("check", &text, &[]).fails(2, &parts);
}

#[test]
fn check_rejects_a_truncated_esi_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let whole = std::fs::read(root().join("configs/esi/EPOS4.xml")).expect("our ESI");
    let cut = folder.path().join("cut.xml");
    std::fs::write(&cut, &whole[..whole.len() / 2]).expect("written");
    let text = axes(1).replace("esi/EPOS4.xml", cut.to_str().expect("UTF-8"));
    let (line, path) = ("cut.xml:909:88 ", "Object[12]/Info/SubItem[5]");
    let parts = [line, path, "the file ends inside a tag"];
    with_file("check", &text, &[]).fails(2, &parts);
}

#[test]
fn check_rejects_a_mode_that_the_esi_does_not_offer() {
    let text = axes(1).replace("\"csp\"", "\"cxp\"");
    with_file("check", &text, &[]).fails(2, &["unknown mode \"cxp\"", "did you mean `csp`?"]);
    let text = axes(1)
        .replace("\"csp\"", "\"hm\"")
        .replace("move =", "dwell = \"1s\" #");
    let parts = ["no axis begins in mode \"hm\"", "\"csp\", \"csv\", \"cst\""];
    with_file("check", &text, &[]).fails(2, &parts);
}

#[test]
fn check_rejects_a_cycle_that_0x60c2_cannot_express() {
    let text = axes(1).replace("\"1ms\"", "\"333333ns\"");
    let parts = ["333333 ns cannot be written to 0x60C2", "330 µs and 340 µs"];
    with_file("check", &text, &[]).fails(2, &parts);
}

#[test]
fn run_rejects_a_missing_interface() {
    let ran = with_file("run", &axes(1), &["--nic", "nonet7"]);
    ran.fails(2, &["error: the interface `nonet7` does not exist"]);
}

#[test]
fn check_reports_every_problem_of_a_file() {
    let text = axes(2)
        .replace("cycle =", "cicle =")
        .replace("name = \"a1\"", "name = \"a0\"")
        .replace("velocity = 50.0", "velocity = -50.0");
    let parts = [
        "unknown key `cicle`",
        "the name \"a0\" is taken",
        "`limits.velocity` is -50 turn/s",
    ];
    with_file("check", &text, &[]).fails(2, &parts);
}

#[test]
fn invalid_command_lines_are_rejected() {
    run(["run", "--cycles"]).fails(2, &["unexpected argument '--cycles'"]);
    run(["run", "configs/no-such.toml"]).fails(2, &["cannot read configs/no-such.toml"]);
    run(["check", "configs/demo.toml"]).exits(0);
}

/// Returns the objects of a PDO table in order, from lines such as `2.0  32  0x607a:00  DINT …`.
fn printed_objects(text: &str) -> Vec<(u16, u8, u16)> {
    text.lines()
        .filter_map(|line| {
            let mut words = line.split_whitespace();
            let (byte, bit) = words.next()?.split_once('.')?;
            byte.parse::<u32>().ok()?;
            bit.parse::<u32>().ok()?;
            let bits = words.next()?.parse().ok()?;
            let (index, sub) = words.next()?.strip_prefix("0x")?.split_once(':')?;
            Some((
                u16::from_str_radix(index, 16).ok()?,
                u8::from_str_radix(sub, 16).ok()?,
                bits,
            ))
        })
        .collect()
}

#[test]
fn explain_prints_the_modules_pdo_contents() {
    let text = run(["explain", "configs/modes.toml"]).exits(0).out;
    let esi = std::fs::read(root().join("configs/esi/EPOS4.xml")).expect("our ESI");
    let esi = ecaxis_esi::parse(&esi).expect("a valid ESI");
    let mut expected = Vec::new();
    for name in ["CSP", "CSV", "CST"] {
        let module = esi
            .modules
            .iter()
            .find(|m| m.type_name == name)
            .expect("a module a mode");
        let pdos = module.rx_pdos.iter().chain(&module.tx_pdos);
        expected.extend(
            pdos.flat_map(|pdo| &pdo.entries)
                .map(|entry| (entry.index, entry.sub, entry.bit_len)),
        );
    }
    assert_eq!(printed_objects(&text), expected, "{text}");
}

/// Runs the demonstration in virtual time with a fault script.
fn with_faults(script: &str) -> Ran {
    let file = tempfile::NamedTempFile::new().expect("a temporary file");
    std::fs::write(file.path(), script).expect("written");
    let path = file.path().to_str().expect("a path in UTF-8");
    run(["run", "configs/demo.toml", "--virtual", "--faults", path])
}

#[test]
fn every_bus_failure_has_code_device_step_cause_and_hint() {
    let fault = |line: &str| format!("[[fault]]\n{line}\n");
    for (script, parts) in [
        (fault("kind = \"silent\""), &["no SubDevice answers"][..]),
        (
            fault("kind = \"absent\"\ndevice = 1"),
            &["`y`", "position 1", "missing"],
        ),
        (
            fault("kind = \"identity\"\ndevice = 1\nrevision = 0x99"),
            &["`y`", "identify", "IDX.xml", "0x00000099"],
        ),
        (
            fault("kind = \"sdo-abort\"\ndevice = 0\nindex = 0x6060\nsub = 0\ncode = 0x06090030"),
            &[
                "`x`",
                "start-up SDO",
                "0x6060:00",
                "0x06090030",
                "out of range",
            ],
        ),
        (
            fault("kind = \"refuse-state\"\ndevice = 1\nstate = \"safeop\"\ncode = 0x001e"),
            &["`y`", "SafeOp", "0x001e", "invalid input configuration"],
        ),
        (
            fault("kind = \"stuck\"\ndevice = 1\nstate = \"switch-on-disabled\""),
            &["`y`", "Operation enabled", "Switch on disabled"],
        ),
        (
            fault("kind = \"drive-fault\"\ndevice = 1\nat = \"1.2s\"\ncode = 0x8611"),
            &["`y`", "drive fault", "0x8611", "following error"],
        ),
    ] {
        let ran = with_faults(&script);
        ran.fails(1, &[parts, &["error:", "= help:"]].concat());
    }
}

#[test]
fn check_rejects_an_esi_file_of_another_device() {
    let text = axes(1).replace("EPOS4.xml", "IO8.xml");
    let parts = [
        "8 digital outputs",
        "offers no mode csp",
        "9 | mode = \"csp\"",
    ];
    with_file("check", &text, &[]).fails(2, &parts);
}

#[test]
fn help_of_every_verb_fits_80_columns_and_has_examples() {
    let run = |arguments: &[&str]| {
        let mut command = program::command();
        Ran::new(command.args(arguments).env("COLUMNS", "80"))
            .exits(0)
            .out
    };
    let all = run(&["--help"]);
    let verbs = all
        .lines()
        .skip_while(|line| *line != "Commands:")
        .skip(1)
        .take_while(|line| !line.is_empty())
        .filter_map(|line| line.strip_prefix("  ")?.split(' ').next())
        .filter(|verb| !verb.is_empty() && *verb != "help");
    let verbs: Vec<&str> = verbs.collect();
    assert!(verbs.len() >= 9, "{verbs:?}");
    for verb in verbs {
        let help = run(&[verb, "--help"]);
        assert!(help.contains("Examples:\n  "), "{verb}: {help}");
        assert!(!help.contains('\u{1b}'), "{verb} has colours: {help:?}");
        for line in help.lines() {
            assert!(line.chars().count() <= 80, "{verb}: `{line}`");
        }
    }
}

#[test]
fn man_writes_a_page_for_every_verb() {
    let folder = tempfile::tempdir().expect("a folder");
    let man = folder.path().join("man1");
    let path = man.to_str().expect("UTF-8");
    run(["man", "--out", path]).exits(0);
    for (page, parts) in [
        ("ecaxis.1", &[".TH ecaxis 1", "ecaxis\\-run(1)"][..]),
        (
            "ecaxis-run.1",
            &[".TH ecaxis-run 1", "\\-\\-faults", ".SH EXAMPLES\n.nf"],
        ),
        (
            "ecaxis-esi-show.1",
            &["ecaxis esi show", "\\-\\-assignment"],
        ),
    ] {
        let text = std::fs::read_to_string(man.join(page)).expect(page);
        assert_contains(&text, parts);
    }
    let kept = std::fs::read_to_string(man.join("ecaxis.1")).expect("read above");
    let one = run(["man"]).exits(0).out;
    assert_eq!(one, kept, "the page on stdout is the one in the folder");
    // A file blocks the output folder.
    let file = format!("{path}/ecaxis.1");
    run(["man", "--out", &file]).fails(2, &["cannot write", &file]);
}

#[test]
fn colours_appear_only_on_request() {
    let stderr = |variables: &[(&str, &str)]| {
        let mut command = program::command();
        command.args(["check", "configs/no-such.toml"]);
        command.env_remove("NO_COLOR").env_remove("CLICOLOR_FORCE");
        Ran::new(command.envs(variables.iter().copied()))
            .exits(2)
            .err
    };
    let plain = stderr(&[]);
    assert!(plain.starts_with("error: "), "{plain:?}");
    assert!(!plain.contains('\u{1b}'), "{plain:?}");
    let coloured = stderr(&[("CLICOLOR_FORCE", "1")]);
    assert!(coloured.contains("\u{1b}["), "{coloured:?}");
    let both = [("CLICOLOR_FORCE", "1"), ("NO_COLOR", "1")];
    assert_eq!(stderr(&both), plain, "NO_COLOR wins");
}

/// A short recording, and other files that a verb might overwrite.
struct Files(tempfile::TempDir);

impl Files {
    fn new() -> Self {
        let files = Self(tempfile::tempdir().expect("a folder"));
        files.records("ok.pcapng", &[]);
        std::fs::write(files.0.path().join("notes.txt"), "dear diary").expect("written");
        files
    }

    fn at(&self, name: &str) -> String {
        let path = self.0.path().join(name);
        path.to_str().expect("UTF-8").to_owned()
    }

    fn read(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.0.path().join(name)).expect("it is there")
    }

    fn records(&self, name: &str, more: &[&str]) {
        let path = self.at(name);
        let line = ["firmware", "info", "configs/demo.toml", "x"];
        let simulated = ["--sim", "--virtual", "--record", &path];
        run([&line[..], &simulated, more].concat()).exits(0);
    }

    /// Checks that a rejected command leaves the file unchanged.
    #[track_caller]
    fn keeps(&self, name: &str, line: &[&str], parts: &[&str]) {
        let before = self.read(name);
        run(line).fails(2, parts);
        assert!(self.read(name) == before, "{line:?}");
    }
}

#[test]
fn firmware_overwrites_only_with_force() {
    let files = Files::new();
    let (notes, program) = (files.at("notes.txt"), files.at("new.bin"));
    let sample = [
        "firmware",
        "sample",
        "configs/demo.toml",
        "x",
        "-o",
        &program,
    ];
    run(sample).exits(0);
    let info = [
        "firmware",
        "info",
        "configs/demo.toml",
        "x",
        "--sim",
        "--virtual",
        "--record",
    ];
    let refused = [
        "--record",
        "exists already",
        "= help: name another file, or overwrite it with `--force`",
    ];
    files.keeps("notes.txt", &[&info[..], &[&notes]].concat(), &refused);
    let update = [
        "firmware",
        "update",
        "configs/demo.toml",
        "x",
        &program,
        "--sim",
        "--virtual",
    ];
    let line = [&update[..], &["--yes", "--force", "--record", &program]].concat();
    files.keeps(
        "new.bin",
        &line,
        &["--record", "new.bin is the firmware file"],
    );
    // The check also applies without a machine file, before any file is opened.
    let bare = [
        "firmware",
        "info",
        "--nic",
        "nonet7",
        "--position",
        "0",
        "--record",
        &notes,
    ];
    files.keeps("notes.txt", &bare, &refused);
    files.records("ok.pcapng", &["--force"]);
    // Outputs for the simulated bus are protected as well.
    files.keeps(
        "notes.txt",
        &[&sample[..5], &[&notes]].concat(),
        &["notes.txt exists already"],
    );
}

#[test]
fn reports_overwrite_only_with_force() {
    let files = Files::new();
    files.records("night2.pcapng", &[]);
    let (ok, night, notes) = (
        files.at("ok.pcapng"),
        files.at("night2.pcapng"),
        files.at("notes.txt"),
    );
    let recording = [
        "--html",
        "is a recording to read",
        "= help: name another file",
    ];
    files.keeps(
        "ok.pcapng",
        &["analyze", &ok, "--force", "--html", &ok],
        &recording,
    );
    // A shell pattern expands to several names instead of one.
    let line = ["analyze", "--html", &ok, &night];
    files.keeps("ok.pcapng", &line, &["--html", "exists already"]);
    std::fs::hard_link(&ok, files.at("hard")).expect("linked");
    std::os::unix::fs::symlink(&ok, files.at("soft")).expect("linked");
    for link in ["hard", "soft"] {
        files.keeps(
            "ok.pcapng",
            &["analyze", &ok, "--html", &files.at(link)],
            &recording,
        );
    }
    files.keeps(
        "notes.txt",
        &["analyze", &ok, "--html", &notes],
        &["exists already"],
    );
    let page = files.at("report.html");
    for force in [&[][..], &["--force"]] {
        run([&["analyze", &ok, "--html", &page], force].concat()).exits(0);
        assert!(files.read("report.html").starts_with(b"<!DOCTYPE html>"));
    }
    let fault_report = [
        "run",
        "configs/demo.toml",
        "--sim",
        "--virtual",
        "--fault-report",
        &notes,
    ];
    files.keeps(
        "notes.txt",
        &fault_report,
        &["--fault-report", "exists already"],
    );
    // Figures and report of a bench are checked before the measurement.
    let both = [
        "bench",
        "--sim",
        "--seconds",
        "1",
        "--force",
        "--html",
        &page,
        "--save",
        &page,
    ];
    files.keeps("report.html", &both, &["--save"]);
    for option in ["--save", "--html"] {
        let line = ["bench", "--sim", "--seconds", "1", option, &notes];
        files.keeps("notes.txt", &line, &[option, "exists already"]);
    }
}

/// Each package may use only these packages of the workspace.
#[test]
fn packages_depend_in_one_direction() {
    let below_master = ["ecaxis-ecat", "ecaxis-esi", "ecaxis-axis", "ecaxis-sim"];
    let below_tools = [&below_master[..], &["ecaxis-master"]].concat();
    let below_server = [&below_tools[..], &["ecaxis-client"]].concat();
    let below_support = [&below_tools[..], &["ecaxis-tools"]].concat();
    let below_cli = [&below_support[..], &["ecaxis-server"]].concat();
    let allowed: [(&str, &[&str]); 10] = [
        ("ecat", &[]),
        ("esi", &["ecaxis-ecat"]),
        ("axis", &[]),
        ("sim", &["ecaxis-esi"]),
        ("master", &below_master),
        ("server", &below_server),
        ("tools", &below_tools),
        ("cli", &below_cli),
        ("clients/rust", &[]),
        ("tests/support", &below_support),
    ];
    let read = |path: &str| -> toml::Table {
        let text = std::fs::read_to_string(root().join(path)).expect("a manifest");
        text.parse().expect("TOML")
    };
    let members = read("Cargo.toml")["workspace"]["members"].clone();
    let folders = allowed.map(|(folder, _)| folder).to_vec();
    assert_eq!(members, toml::Value::from(folders));
    for (folder, allowed) in allowed {
        let manifest = read(&format!("{folder}/Cargo.toml"));
        let targets = manifest.get("target").and_then(|t| t.as_table());
        let targets = targets.into_iter().flat_map(|targets| targets.values());
        let tables = std::iter::once(&toml::Value::Table(manifest.clone()))
            .chain(targets)
            .flat_map(|table| ["dependencies", "build-dependencies"].map(|key| table.get(key)))
            .flatten()
            .filter_map(|table| table.as_table())
            .flat_map(|table| table.keys().cloned())
            .collect::<Vec<_>>();
        for name in &tables {
            let ours = name.starts_with("ecaxis");
            assert!(
                !ours || allowed.contains(&name.as_str()),
                "{folder} uses {name}"
            );
        }
        if folder == "ecat" {
            assert_eq!(tables, ["thiserror"], "the vocabulary stays small");
        }
    }
}

/// Returns the names after each `crate::` of a source file, without comments and in-file tests.
fn used_modules(text: &str) -> Vec<String> {
    let mut lines = text.lines().peekable();
    let mut code = String::new();
    while let Some(line) = lines.next() {
        if line == "#[cfg(test)]" && lines.peek().is_some_and(|next| next.ends_with('{')) {
            break;
        }
        code += line.split("//").next().unwrap_or_default();
        code.push('\n');
    }
    let names = |rest: &str| -> Vec<String> {
        let paths = match rest.strip_prefix('{') {
            Some(group) => group.split(['}', ';']).next().unwrap_or_default(),
            None => rest,
        };
        let count = if paths.len() == rest.len() {
            1
        } else {
            usize::MAX
        };
        let first = |path: &str| {
            let end = path.find(|c: char| !c.is_alphanumeric() && c != '_');
            path[..end.unwrap_or(path.len())].to_owned()
        };
        paths
            .split(',')
            .take(count)
            .map(|path| first(path.trim()))
            .collect()
    };
    code.split("crate::").skip(1).flat_map(names).collect()
}

/// A module of the library may use the modules below it, never one that uses it.
#[test]
fn modules_of_the_library_have_no_circles() {
    let source = root().join("master/src");
    let mut uses = std::collections::BTreeMap::<String, std::collections::BTreeSet<String>>::new();
    let mut folders = vec![source.clone()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            let name = path.file_stem().and_then(|n| n.to_str()).expect("a name");
            if name.ends_with("tests") || name == "lib" || name == "documented" {
                continue;
            }
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let below = path.strip_prefix(&source).expect("below");
            let module = below
                .iter()
                .next()
                .and_then(|n| n.to_str())
                .expect("a name");
            let module = module.trim_end_matches(".rs").to_owned();
            let text = std::fs::read_to_string(&path).expect("a source file");
            let used = used_modules(&text)
                .into_iter()
                .filter(|used| *used != module);
            uses.entry(module.clone()).or_default().extend(used);
        }
    }
    let known: Vec<String> = uses.keys().cloned().collect();
    for used in uses.values_mut() {
        used.retain(|module| known.contains(module));
    }
    assert!(
        uses["session"].contains("config"),
        "uses are found: {uses:?}"
    );
    // Takes away modules that use nothing more; the modules of a circle stay.
    while let Some(bottom) = uses.iter().find(|(_, used)| used.is_empty()) {
        let bottom = bottom.0.clone();
        uses.remove(&bottom);
        for used in uses.values_mut() {
            used.remove(&bottom);
        }
    }
    assert!(uses.is_empty(), "modules that use each other: {uses:#?}");
}

/// The cycle takes plain data. Of its package it uses only what lies below it.
#[test]
fn the_cycle_depends_on_links_and_clocks_only() {
    let mut folders = vec![root().join("master/src/rt")];
    let mut used = std::collections::BTreeSet::new();
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let text = std::fs::read_to_string(path).expect("a source file");
            let modules = text.split("crate::").skip(1);
            let name = |rest: &str| rest.split([':', ';', ')']).next().map(str::to_owned);
            used.extend(modules.filter_map(name));
        }
    }
    let used: Vec<_> = used.iter().map(String::as_str).collect();
    assert_eq!(used, ["clock", "link", "rt"]);
}
