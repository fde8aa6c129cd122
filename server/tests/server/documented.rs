//! The examples of docs/server.md do what they say.

use std::process::Command;

use crate::harness::{Server, demo};

const DOCUMENT: &str = include_str!("../../../docs/server.md");

/// Returns the first text between both marks.
fn between<'t>(text: &'t str, begin: &str, end: &str) -> &'t str {
    let (_, after) = text.split_once(begin).expect("the begin of the example");
    after.split_once(end).expect("its end").0
}

fn python(code: &str) -> Option<String> {
    let ran = match Command::new("python3").arg("-c").arg(code).output() {
        Err(error) if std::env::var_os("CI").is_none() => {
            println!("skipped: python3: {error}");
            return None;
        }
        ran => ran.expect("python3"),
    };
    let errors = String::from_utf8_lossy(&ran.stderr);
    assert!(ran.status.success(), "{code}\n{errors}");
    Some(String::from_utf8(ran.stdout).expect("text"))
}

#[test]
fn examples_of_the_document_run() {
    let section = between(DOCUMENT, "## Five minutes", "## Options");
    let first = between(section, "python3 - <<'end'\n", "\nend\n");
    let (_, section) = DOCUMENT
        .split_once("## In virtual time")
        .expect("a section");
    let virtual_time = between(section, "```python\n", "```");
    for server in [
        Server::in_virtual_time(demo()),
        Server::in_real_time(demo()),
    ] {
        let code = first.replace("demo.sock", server.socket().to_str().expect("a path"));
        let Some(printed) = python(&code) else {
            return;
        };
        let position: f64 = printed.trim().parse().expect("the position");
        assert!((position - 20.0).abs() < 1.0, "{position}");
    }
    let server = Server::in_virtual_time(demo());
    let code = first.replace("demo.sock", server.socket().to_str().expect("a path"));
    python(&format!("{code}\n{virtual_time}"));
}
