//! Signed files: what the policy refuses is refused before the first frame.

use std::path::{Path, PathBuf};

use ecaxis_test_support::program::{self, Ran};
use ecaxis_test_support::root;
use minisign::KeyPair;
use serde_json::Value;

/// A machine with a set-point table and a firmware file, and the policy that wants all of it signed.
struct Signed {
    folder: tempfile::TempDir,
    keys: KeyPair,
}

const MACHINE: &str = "together.toml";
const ESI: &str = "esi/EPOS4.xml";
const TABLE: &str = "points.csv";
const FIRMWARE: &str = "new.bin";
/// The time in the trusted comments, and `not_before` of the policy.
const SIGNED_AT: u64 = 1_800_000_000;

impl Signed {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let keys = KeyPair::generate_unencrypted_keypair().unwrap();
        let signed = Self { folder, keys };
        std::fs::create_dir(signed.path("esi")).unwrap();
        for name in [MACHINE, ESI, TABLE] {
            std::fs::copy(root().join("configs").join(name), signed.path(name)).unwrap();
        }
        let line = [
            "firmware",
            "sample",
            "~/together.toml",
            "x",
            "-o",
            "~/new.bin",
        ];
        signed.run(&line, "").exits(0);
        for name in [MACHINE, ESI, TABLE, FIRMWARE] {
            signed.sign(name);
        }
        let policy = format!(
            "require = ['machine', 'esi', 'tables', 'firmware']\nnot_before = {SIGNED_AT}\n\
             [[key]]\nname = 'release'\npublic = '{}'\n",
            signed.keys.pk.to_base64()
        );
        std::fs::write(signed.path("policy.toml"), policy).unwrap();
        signed
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn sign(&self, name: &str) {
        sign_with(&self.keys, &self.path(name), SIGNED_AT);
    }

    /// Runs the program. `policy`: the file's name, or nothing. `~` is the folder.
    fn run(&self, words: &[&str], policy: &str) -> Ran {
        let folder = self.folder.path().to_str().unwrap();
        let mut command = program::command();
        command.env("ECAXIS_CHANGE_LOG", self.path("changes.jsonl"));
        command.env(
            "ECAXIS_POLICY",
            match policy {
                "" => PathBuf::new(),
                name => self.path(name),
            },
        );
        Ran::new(command.args(words.iter().map(|word| word.replace('~', folder))))
    }

    /// Runs a command that sends frames, and records them. Returns whether there was one.
    fn frames(&self, words: &[&str]) -> (Ran, bool) {
        let record = self.path("frames.pcapng");
        let _ = std::fs::remove_file(&record);
        let words = [words, &["--sim", "--record", "~/frames.pcapng"]].concat();
        let ran = self.run(&words, "policy.toml");
        (ran, record.exists())
    }
}

fn signature_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".minisig");
    name.into()
}

fn sign_with(keys: &KeyPair, path: &Path, time: u64) {
    let name = path.file_name().unwrap().to_str().unwrap();
    let comment = format!("timestamp:{time}\tfile:{name}\thashed");
    let bytes = std::fs::read(path).unwrap();
    let made = minisign::sign(Some(&keys.pk), &keys.sk, &bytes[..], Some(&comment), None);
    std::fs::write(signature_path(path), made.unwrap().to_string()).unwrap();
}

fn replace(path: &Path, from: &str, to: &str) {
    let text = std::fs::read_to_string(path).unwrap();
    assert!(text.contains(from), "{from} is in {}", path.display());
    std::fs::write(path, text.replacen(from, to, 1)).unwrap();
}

const RUN: [&str; 5] = [
    "run",
    "~/together.toml",
    "--virtual",
    "--no-enable",
    "--for=1ms",
];
const UPDATE: [&str; 6] = [
    "firmware",
    "update",
    "~/together.toml",
    "x",
    "~/new.bin",
    "--yes",
];

/// A file, the command that uses it, and what its `require` calls it.
const USES: [(&str, &[&str], &str); 4] = [
    (MACHINE, &RUN, "machine files"),
    (ESI, &RUN, "ESI files"),
    (TABLE, &RUN, "set-point tables"),
    (FIRMWARE, &UPDATE, "firmware"),
];

#[test]
fn a_signed_machine_runs_and_check_names_the_keys() {
    let signed = Signed::new();
    let (ran, sent) = signed.frames(&RUN);
    ran.exits(0);
    assert!(sent);
    let (ran, sent) = signed.frames(&UPDATE);
    ran.exits(0);
    assert!(sent);
    let checked = signed
        .run(&["check", "~/together.toml"], "policy.toml")
        .exits(0);
    for (name, ..) in &USES[..3] {
        let path = signed.path(name);
        let line = format!("{}: signed by release (", path.display());
        assert!(checked.out.contains(&line), "{line}: {}", checked.out);
    }
    let json = signed.run(&["check", "~/together.toml", "--json"], "policy.toml");
    let digest = json.json()["sha256"].clone();
    let files = json.json()["files"].clone();
    let files = files.as_array().unwrap();
    let by = |file: &Value| file["signed_by"].as_str().unwrap().to_owned();
    assert_eq!(files.len(), 3);
    assert!(files.iter().all(|file| by(file).starts_with("release (")));
    // Neither signatures nor the policy are part of the digest; without a policy, none counts.
    std::fs::write(signature_path(&signed.path(TABLE)), "no signature").unwrap();
    let unchecked = signed.run(&["check", "~/together.toml", "--json"], "");
    assert_eq!(unchecked.json()["sha256"], digest);
    assert_eq!(unchecked.json()["files"][0]["signed_by"], Value::Null);

    let log = std::fs::read_to_string(signed.path("changes.jsonl")).unwrap();
    let begin = log
        .lines()
        .find(|line| line.contains("\"sha256\""))
        .unwrap();
    let begin: Value = serde_json::from_str(begin).unwrap();
    assert_eq!(begin["signed_by"].as_str(), Some(by(&files[0]).as_str()));
}

#[test]
fn what_the_policy_refuses_is_refused_before_the_first_frame() {
    type Damage = fn(&Signed, &Path);
    let damages: [(&str, Damage); 7] = [
        ("differs from what was signed", |_, path| {
            let mut bytes = std::fs::read(path).unwrap();
            bytes.push(b'\n');
            std::fs::write(path, bytes).unwrap();
        }),
        ("differs from what was signed", |_, path| {
            // An older signature that claims to be new.
            replace(
                &signature_path(path),
                "timestamp:1800000000",
                "timestamp:1900000000",
            );
        }),
        ("damaged signature", |_, path| {
            std::fs::write(signature_path(path), "untrusted comment: x\n").unwrap();
        }),
        ("which the policy does not list", |_, path| {
            let other = KeyPair::generate_unencrypted_keypair().unwrap();
            sign_with(&other, path, SIGNED_AT);
        }),
        ("before `not_before`", |signed, path| {
            sign_with(&signed.keys, path, SIGNED_AT - 1);
        }),
        ("signature of another file, `other`", |signed, path| {
            let other = path.with_file_name("other");
            std::fs::copy(path, &other).unwrap();
            sign_with(&signed.keys, &other, SIGNED_AT);
            std::fs::rename(signature_path(&other), signature_path(path)).unwrap();
        }),
        ("has no signature", |_, path| {
            std::fs::remove_file(signature_path(path)).unwrap()
        }),
    ];
    let signed = Signed::new();
    for (name, words, kind) in USES {
        let path = signed.path(name);
        let intact = std::fs::read(&path).unwrap();
        for (why, damage) in damages {
            damage(&signed, &path);
            let (ran, sent) = signed.frames(words);
            ran.fails(2, &[name, why, "help: "]);
            if why == "has no signature" {
                ran.fails(2, &[kind]);
            }
            assert!(!sent, "{name}: {why}");
            std::fs::write(&path, &intact).unwrap();
            signed.sign(name);
        }
    }
    // The interface is not even looked for.
    std::fs::remove_file(signature_path(&signed.path(ESI))).unwrap();
    let words = ["run", "~/together.toml", "--nic", "nonexistent0"];
    signed
        .run(&words, "policy.toml")
        .fails(2, &[ESI, "has no signature"]);
    signed.run(&words, "").fails(2, &["nonexistent0"]);
    // The reason is in the change log.
    let log = std::fs::read_to_string(signed.path("changes.jsonl")).unwrap();
    assert!(log.contains("has no signature"), "{log}");
}

#[test]
fn a_policy_that_cannot_be_used_lets_nothing_pass() {
    let signed = Signed::new();
    std::fs::write(signed.path("bad.toml"), "require = ['everything']").unwrap();
    for (policy, why) in [("bad.toml", "everything"), ("none.toml", "No such file")] {
        for words in [&RUN[..], &["check", "~/together.toml"]] {
            let words = [words, &["--sim"][..usize::from(words[0] == "run")]].concat();
            signed
                .run(&words, policy)
                .fails(2, &[policy, why, "ECAXIS_POLICY"]);
        }
        let words = [
            "firmware",
            "update",
            "--nic",
            "nonexistent0",
            "--position=0",
            "~/new.bin",
        ];
        signed.run(&words, policy).fails(2, &[policy, why]);
    }
    // The demonstration is part of the program.
    let demonstration = ["run", "--virtual", "--for=1ms", "--no-enable"];
    signed.run(&demonstration, "policy.toml").exits(0);
}
