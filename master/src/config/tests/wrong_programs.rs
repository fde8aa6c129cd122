//! 200 wrong programs: `check` refuses each with the line of the mistake and a remedy.

use super::*;

const ROWS: &str = include_str!("wrong_programs.txt");

const SIGNALS: &str = "a = \"io.Input 1\"\nlamp = \"io.Output 1\"\n";
const VARIABLES: &str = "n = 0\n\
    h = { initial = 1.0, range = [0.0, 10.0] }\n\
    big = { initial = 100.0, range = [100.0, 200.0] }\n\
    neg = { initial = 0.0, range = [-1.0, 1.0] }\n";

fn axis(name: &str, position: u32, mode: &str, limits: &str) -> String {
    format!(
        "[[device]]\nname = \"{name}\"\nesi = \"esi/EPOS4.xml\"\nposition = {position}\n\
         mode = \"{mode}\"\n[device.axis]\nencoder = 2000\n{limits}\n"
    )
}

/// Returns a machine file that begins with a program.
fn file(program: &str) -> String {
    let mm = "unit = \"mm\"\nper_turn = 5.0\n\
              limits = { position = [-10.0, 10.0], velocity = 50.0, acceleration = 500.0 }";
    let turns = "unit = \"turn\"\nper_turn = 1.0\nlimits = { velocity = 50.0, acceleration = 500.0, torque = 100.0 }";
    let mut text = program.replace('|', "\n") + "\n";
    for (table, entries) in [("[signals]\n", SIGNALS), ("[variables]\n", VARIABLES)] {
        // A row may add to the table.
        if !text.starts_with(table) {
            text += table;
        }
        text += entries;
    }
    // The entries of a row's table must follow it.
    if text.starts_with("[variables]\n") {
        text = program.replace('|', "\n") + "\n" + VARIABLES + "[signals]\n" + SIGNALS;
    }
    text += "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n";
    text += &axis("x", 0, "csp", mm);
    text += &axis("y", 1, "csp", mm);
    text += &axis("v", 2, "csv", turns);
    text += &axis("t", 3, "cst", turns);
    text += "[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 4\n";
    text
}

fn load(text: &str) -> Result<Machine, ConfigError> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../configs");
    parse(&folder.join("m.toml"), text)
}

#[test]
fn every_wrong_program_is_refused_with_line_and_remedy() {
    let rows: Vec<_> = ROWS.lines().filter(|row| !row.starts_with('#')).collect();
    assert!(rows.len() >= 200, "{}", rows.len());
    let mut wrong = Vec::new();
    for row in rows {
        let parts: Vec<_> = row.splitn(4, ';').map(str::trim).collect();
        let [line, message, remedy, program] = parts[..] else {
            panic!("{row}");
        };
        let found = match load(&file(program)) {
            Err(ConfigError::Problems(found)) => found,
            Err(error) => panic!("{row}: {error}"),
            Ok(_) => Vec::new(),
        };
        let [problem] = found.as_slice() else {
            wrong.push(format!(
                "{row}\n   {} problems: {}",
                found.len(),
                ConfigError::Problems(found)
            ));
            continue;
        };
        let hint = problem.hint.as_deref().unwrap_or_default();
        let right = problem.line.to_string() == line
            && problem.message.contains(message)
            && !hint.is_empty()
            && hint.contains(remedy);
        if !right {
            wrong.push(format!(
                "{row}\n   {}: {} = {hint}",
                problem.line, problem.message
            ));
        }
    }
    assert!(
        wrong.is_empty(),
        "{} rows:\n{}",
        wrong.len(),
        wrong.join("\n")
    );
}

/// The same words in their right places are accepted.
#[test]
fn right_programs_are_accepted() {
    for program in [
        "[[step]]|move = { x = \"h\" }|[[step]]|dwell = \"h\"|[[step]]|add = { h = \"n\" }",
        "[[step]]|parallel = [{ step = [{ wait = { n = 1 }, timeout = \"none\" }] }, { step = [{ let = { n = 1 } }] }]",
        "[[step]]|parallel = [{ step = [{ gear = { y = { to = \"x\" } } }] }, { step = [{ move = { x = 1.0 } }] }]",
        "[[step]]|while = { n = { below = 3 } }|step = [{ add = { n = 1 } }]",
        "[[sub]]|name = \"s\"|parameters = [\"axis\", \"to\", \"pace\", \"in\"]|step = [{ wait = { \"$in\" = true } }, { move = { \"$axis\" = \"$to\" }, speed = \"$pace\" }]|\
         [[step]]|call = \"s\"|with = { axis = \"x\", to = 5.0, pace = 0.5, in = \"a\" }|[[step]]|call = \"s\"|with = { axis = \"y\", to = \"h\", pace = 1.0, in = \"a\" }",
        "[[sub]]|name = \"s\"|step = [{ call = \"r\", with = { to = 1.0 } }]|[[sub]]|name = \"r\"|parameters = [\"to\"]|step = [{ move = { x = \"$to\" } }]|[[step]]|call = \"s\"",
        "[program]|pause = { a = true }|step = { io.\"Input 2\" = true }|[[step]]|enable = true",
    ] {
        if let Err(error) = load(&file(program)) {
            panic!("{program}:\n{error}");
        }
    }
}
