//! Sets the commit of a release build.

use std::process::Command;

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim().to_owned())
}

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    // Each commit would build everything again.
    if std::env::var("PROFILE").as_deref() != Ok("release") {
        return;
    }
    // A package from a registry is in no work tree, or in that of another project.
    if git(&["ls-files", "--error-unmatch", "build.rs"]).is_none() {
        return;
    }
    if let Some(log) = git(&["rev-parse", "--git-path", "logs/HEAD"]) {
        println!("cargo::rerun-if-changed={log}");
    }
    if let Some(commit) = git(&["describe", "--always", "--abbrev=12", "--dirty"]) {
        println!("cargo::rustc-env=ECAXIS_COMMIT={commit}");
    }
}
