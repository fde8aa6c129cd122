//! Bundles and orders against damage, and against senders without rights.

mod server;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use minisign::KeyPair;
use proptest::prelude::*;

use super::digest::FileDigest;
use super::executor::{OrderExecutor, OrdersTable, unix_time};
use super::manifest::{BundleFile, BundlePath, FileRef, Manifest};
use super::order::{Action, Order, OrderReply, SignedOrder, Status};
use super::signing::{KeyTable, Keyring, Right, Signer};
use super::slots::{Slots, Switch, Unpacked};
use super::store::{CHUNK, FileSource, FileStore};
use crate::error::{Error, Result};
use crate::keys::MachineId;

fn machine() -> MachineId {
    "hall/m1".parse().unwrap()
}

fn file(path: &str, bytes: &[u8]) -> BundleFile {
    BundleFile {
        path: path.to_owned().try_into().unwrap(),
        sha256: FileDigest::of(bytes),
        size: bytes.len() as u64,
    }
}

fn manifest(files: Vec<BundleFile>) -> Manifest {
    let main = files[0].path.clone();
    let digest = FileDigest::of(b"machine");
    Manifest::new(
        machine(),
        main,
        digest,
        1_795_600_000,
        "0.1.0".to_owned(),
        files,
    )
    .unwrap()
}

fn key(keys: &KeyPair, rights: &[Right]) -> KeyTable {
    KeyTable {
        name: "anna".to_owned(),
        public: keys.pk.to_base64(),
        rights: rights.to_vec(),
    }
}

fn keys() -> (Signer, KeyPair) {
    let keys = KeyPair::generate_unencrypted_keypair().unwrap();
    (Signer::from(keys.sk.clone()), keys)
}

/// Files in memory. Fails after some chunks.
struct Memory {
    files: BTreeMap<FileDigest, Vec<u8>>,
    chunks: std::sync::atomic::AtomicUsize,
}

impl Memory {
    fn new(files: &[&[u8]], chunks: usize) -> Self {
        let files = files
            .iter()
            .map(|b| (FileDigest::of(b), b.to_vec()))
            .collect();
        Self {
            files,
            chunks: chunks.into(),
        }
    }
}

impl FileSource for Memory {
    fn chunk(&self, digest: FileDigest, offset: u64) -> Result<Vec<u8>> {
        use std::sync::atomic::Ordering::Relaxed;
        let left = self
            .chunks
            .fetch_update(Relaxed, Relaxed, |n| n.checked_sub(1));
        left.map_err(|_| Error::new("the sender is gone"))?;
        let file = self
            .files
            .get(&digest)
            .ok_or_else(|| Error::new("unknown"))?;
        let offset = usize::try_from(offset).unwrap();
        Ok(file[offset..file.len().min(offset + CHUNK)].to_vec())
    }
}

#[test]
fn paths_stay_in_the_folder_of_the_bundle() {
    for path in [
        "",
        "/etc/passwd",
        "../a",
        "a/../b",
        "a//b",
        "./a",
        "a/",
        "a\\b",
        "a\nb",
        "a\0b",
        "a/b/c/d/e/f/g/h/i",
        &"a".repeat(256),
    ] {
        assert!(BundlePath::try_from(path.to_owned()).is_err(), "{path:?}");
    }
    for path in ["machine.toml", "esi/EPOS4.xml", "..a", "ä b.xml"] {
        assert!(BundlePath::try_from(path.to_owned()).is_ok(), "{path:?}");
    }
}

#[test]
fn manifests_beyond_the_limits_are_refused() {
    let good = manifest(vec![file("m.toml", b"m"), file("esi/a.xml", b"a")]);
    let refused = |change: &dyn Fn(&mut Manifest), why: &str| {
        let mut changed = good.clone();
        change(&mut changed);
        let error = Manifest::parse(&changed.emit()).unwrap_err().to_string();
        assert!(error.contains(why), "{error}");
    };
    refused(&|m| m.ecaxis_bundle = 2, "its format is 2");
    refused(
        &|m| m.files[1].size = (64 << 20) + 1,
        "`esi/a.xml` is longer",
    );
    refused(&|m| m.files.push(file("m.toml", b"n")), "listed twice");
    refused(
        &|m| m.files.push(file("m.toml/x", b"n")),
        "folder of `m.toml/x`",
    );
    refused(
        &|m| drop(m.files.remove(0)),
        "machine file `m.toml` is missing",
    );
    refused(
        &|m| {
            let each = (0..5).map(|n| {
                let mut big = file(&format!("big{n}"), b"b");
                big.size = 60 << 20;
                big
            });
            m.files.extend(each);
        },
        "more than 268435456 bytes",
    );
    refused(
        &|m| {
            m.files
                .extend((0..1000).map(|n| file(&format!("f{n}"), b"f")))
        },
        "more than 1000 files",
    );
}

fn names() -> impl Strategy<Value = Vec<(String, Vec<u8>)>> {
    let path = "[a-z]{1,8}(/[a-zA-Z0-9_. -]{1,8}x){0,2}";
    proptest::collection::btree_map(path, proptest::collection::vec(any::<u8>(), 0..64), 1..20)
        .prop_map(|files| files.into_iter().collect())
}

proptest! {
    #[test]
    fn a_manifest_is_read_as_it_was_written(files in names(), created in any::<u64>()) {
        let listed: Vec<_> = files.iter().map(|(path, bytes)| file(path, bytes)).collect();
        let main = listed[0].path.clone();
        let made = Manifest::new(
            machine(), main, FileDigest::of(b"x"), created, "0.1.0".to_owned(), listed,
        );
        // A file may be the folder of another: refused when made and when read.
        if let Ok(made) = made {
            prop_assert_eq!(Manifest::parse(&made.emit()).unwrap(), made);
        }
    }

    #[test]
    fn a_damaged_manifest_is_read_or_refused(at in any::<usize>(), byte in any::<u8>()) {
        let made = manifest(vec![file("m.toml", b"m"), file("esi/a.xml", b"a")]);
        let mut text = made.emit();
        let at = at % text.len();
        text[at] = byte;
        if let Ok(read) = Manifest::parse(&text) {
            prop_assert!(read.files.iter().all(|file| !file.path.as_path().is_absolute()));
        }
        let _ = Manifest::parse(&text[..at]);
    }

    #[test]
    fn any_bytes_are_read_or_refused(bytes in proptest::collection::vec(any::<u8>(), 0..512)) {
        let _ = Manifest::parse(&bytes);
        let _ = SignedOrder::parse(&bytes);
        let text = String::from_utf8_lossy(&bytes);
        let _ = Order::parse(&text);
        prop_assert!(Keyring::default().verify("it", &bytes, &text).is_err());
    }
}

#[test]
fn a_signature_with_any_changed_byte_is_refused() {
    let (signer, pair) = keys();
    let trusted = Keyring::new(&[key(&pair, &[Right::Bundle])]).unwrap();
    let text = manifest(vec![file("m.toml", b"m")]).emit();
    let signature = signer.sign(&text, "manifest.json", 1_795_600_000).unwrap();
    assert_eq!(
        trusted.verify("it", &text, &signature).unwrap().name,
        "anna"
    );
    let first_line = signature.find('\n').unwrap();
    for at in 0..signature.len() {
        let mut changed = signature.clone().into_bytes();
        changed[at] ^= 1;
        let changed = String::from_utf8_lossy(&changed).into_owned();
        // The first line is the untrusted comment; line ends may become other white space.
        if at > first_line && !signature[at..].starts_with('\n') && at + 1 < signature.len() {
            assert!(
                trusted.verify("it", &text, &changed).is_err(),
                "byte {at}: {changed}"
            );
        } else {
            let _ = trusted.verify("it", &text, &changed);
        }
        let _ = trusted.verify("it", &text, &signature[..at]);
    }
    for at in 0..text.len() {
        let mut changed = text.clone();
        changed[at] ^= 0x20;
        let error = trusted.verify("it", &changed, &signature).unwrap_err();
        assert!(error.to_string().contains("wrong signature"), "{error}");
    }
    let (_, other) = keys();
    let others = Keyring::new(&[key(&other, &[Right::Bundle])]).unwrap();
    let error = others
        .verify("it", &text, &signature)
        .unwrap_err()
        .to_string();
    assert!(error.contains("does not list"), "{error}");
}

#[test]
fn a_public_key_has_one_name() {
    let (_, pair) = keys();
    let twice = [key(&pair, &[Right::Push]), key(&pair, &[Right::Bundle])];
    let error = Keyring::new(&twice).unwrap_err().to_string();
    assert!(error.contains("same public key"), "{error}");
}

#[test]
fn a_program_runs_to_its_end_after_a_lost_lease() {
    let words = ["sh", "-c", "sleep 0.3; touch \"$0\""].map(str::to_owned);
    let folder = tempfile::tempdir().unwrap();
    let done = folder.path().join("done");
    let words = [&words[..], &[done.display().to_string()]].concat();
    let lost = &mut || Err(Error::new("lost"));
    let error = super::program::run(&words, Duration::from_secs(20), lost).unwrap_err();
    assert!(error.to_string().contains("lost"));
    assert!(done.exists());
}

#[test]
fn keys_of_minisign_sign_with_and_without_a_password() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("secret");
    let password = folder.path().join("password");
    let pair = KeyPair::generate_unencrypted_keypair().unwrap();
    fs::write(&path, pair.sk.to_box(None).unwrap().into_string()).unwrap();
    assert!(
        Signer::load(&path, None)
            .unwrap()
            .sign(b"a", "a", 1)
            .is_ok()
    );
    let pair = KeyPair::generate_encrypted_keypair(Some("secret".to_owned())).unwrap();
    fs::write(&path, pair.sk.to_box(None).unwrap().into_string()).unwrap();
    fs::write(&password, "secret\n").unwrap();
    let signer = Signer::load(&path, Some(&password)).unwrap();
    let signature = signer.sign(b"a", "a", 1).unwrap();
    let trusted = Keyring::new(&[key(&pair, &[])]).unwrap();
    assert!(trusted.verify("it", b"a", &signature).is_ok());
    fs::write(&password, "other\n").unwrap();
    assert!(Signer::load(&path, Some(&password)).is_err());
}

#[test]
fn a_transfer_continues_and_other_content_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let store = FileStore::open(folder.path(), Duration::ZERO).unwrap();
    let bytes: Vec<u8> = (0..3 * CHUNK + 7).map(|n| (n % 251) as u8).collect();
    let content = FileRef::of(&bytes);
    let mut begun = Vec::new();
    let gone = Memory::new(&[&bytes], 2);
    assert!(
        store
            .get(content, &gone, &mut |have| begun.push(have))
            .is_err()
    );
    let mut resumed = Vec::new();
    let back = Memory::new(&[&bytes], 2);
    let got = store
        .get(content, &back, &mut |have| resumed.push(have))
        .unwrap();
    assert_eq!(got, bytes);
    assert_eq!(resumed[0], 2 * CHUNK as u64);
    assert_eq!(
        store
            .get(content, &Memory::new(&[], 0), &mut |_| ())
            .unwrap(),
        bytes
    );
    // A sender that returns other bytes.
    let mut false_source = Memory::new(&[], 9);
    let wanted = FileRef::of(b"wanted");
    false_source.files.insert(wanted.sha256, b"others".to_vec());
    let error = store
        .get(wanted, &false_source, &mut |_| ())
        .unwrap_err()
        .to_string();
    assert!(error.contains("another content"), "{error}");
    assert_eq!(
        store
            .get(wanted, &Memory::new(&[b"wanted"], 9), &mut |_| ())
            .unwrap(),
        b"wanted"
    );
    // Only what is needed stays, and its part.
    let part = folder.path().join(format!("{}.part", content.sha256));
    fs::write(&part, b"begun").unwrap();
    store.keep(&[content.sha256].into()).unwrap();
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
    store.keep(&[].into()).unwrap();
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn slots_change_at_once_and_go_back() {
    let folder = tempfile::tempdir().unwrap();
    let slots = Slots::open(folder.path()).unwrap();
    let unpack = |content: &[u8]| {
        let made = manifest(vec![file("m.toml", content)]);
        let text = made.emit();
        let unpacked = Unpacked {
            id: FileDigest::of(&text),
            text,
            signature: "s".to_owned(),
            manifest: made,
        };
        slots.unpack(&unpacked, &[content.to_vec()]).unwrap();
        unpacked.id
    };
    let switch = |to| Switch {
        to,
        current: slots.current(),
        previous: slots.previous(),
        sender: "anna".to_owned(),
        nonce: None,
    };
    let read = || fs::read(folder.path().join("current/m.toml")).unwrap();
    let take = |content| {
        let id = unpack(content);
        slots.switch(&switch(id)).unwrap();
        slots.confirm().unwrap();
        slots.clean().unwrap();
        id
    };
    let (a, b) = (take(b"a"), take(b"b"));
    assert_eq!((read(), slots.previous()), (b"b".to_vec(), Some(a)));
    let c = unpack(b"c");
    let pending = switch(c);
    slots.switch(&pending).unwrap();
    assert_eq!((read(), slots.previous()), (b"c".to_vec(), Some(b)));
    // Another process continues it.
    let again = Slots::open(folder.path()).unwrap();
    assert_eq!(again.pending().unwrap(), Some(pending.clone()));
    assert_eq!(again.clean().unwrap(), None);
    again.undo(&pending).unwrap();
    again.confirm().unwrap();
    let refused = unpack(b"d");
    let kept = again.clean().unwrap();
    assert_eq!((read(), slots.previous()), (b"b".to_vec(), Some(a)));
    assert_eq!(again.pending().unwrap(), None);
    assert!(!slots.path(c).exists() && !slots.path(refused).exists());
    let files = [b"a", b"b"].map(|t| FileDigest::of(t));
    assert_eq!(kept, Some(files.into()));
    // Two links, two folders, two manifests with their signatures.
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 8);
    // A link that an operator has made by hand: nothing is removed.
    fs::remove_file(folder.path().join("current")).unwrap();
    std::os::unix::fs::symlink("/elsewhere/bundle", folder.path().join("current")).unwrap();
    let error = again.clean().unwrap_err().to_string();
    assert!(error.contains("is not a link to the digest"), "{error}");
}

fn executor(folder: &Path, keys: &[KeyTable]) -> Arc<OrderExecutor> {
    executor_with(folder, keys, "false", Memory::new(&[], 0))
}

fn executor_with(
    folder: &Path,
    keys: &[KeyTable],
    ecaxis: &str,
    source: Memory,
) -> Arc<OrderExecutor> {
    let table = OrdersTable {
        folder: folder.join("orders"),
        machine_file: folder.join("orders/current/m.toml"),
        ecaxis: ecaxis.to_owned(),
        restart: vec!["true".to_owned()],
        health_timeout_s: 1,
        compare: false,
    };
    let (file, socket) = (folder.join("agent.toml"), folder.join("m.sock"));
    OrderExecutor::open(&file, machine(), socket, &table, keys, Arc::new(source)).unwrap()
}

fn order(signer: &Signer, nonce: u8, change: impl Fn(&mut Order)) -> Vec<u8> {
    let now = unix_time();
    let action = Action::Start { at_unix_ns: None };
    let nonce = format!("{nonce:032x}");
    let mut order = Order::new(machine(), action, now - 10, now + 10, nonce);
    change(&mut order);
    let order = serde_json::to_string(&order).unwrap();
    let signature = signer.sign(order.as_bytes(), "order.json", now).unwrap();
    SignedOrder { order, signature }.emit()
}

fn outcome(executor: &Arc<OrderExecutor>, order: &[u8]) -> OrderReply {
    let begin = Instant::now();
    loop {
        let reply = executor.receive(order);
        if reply.status != Status::Running || begin.elapsed() > Duration::from_secs(20) {
            return reply;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn orders_without_right_time_or_place_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (signer, pair) = keys();
    let executor = executor(folder.path(), &[key(&pair, &[Right::Start])]);
    let refused = |bytes: &[u8], why: &str| {
        let reply = executor.receive(bytes);
        assert_eq!(reply.status, Status::Refused, "{}", reply.text);
        assert!(reply.text.contains(why), "{}", reply.text);
    };
    refused(
        &order(&signer, 1, |o| o.machine = "hall/m2".parse().unwrap()),
        "is for hall/m2",
    );
    let begin = unix_time();
    let end = begin - 9;
    let expired = executor.receive(&order(&signer, 2, |o| {
        (o.not_before, o.not_after) = (end - 1, end);
    }));
    let mut texts = (begin..=unix_time()).map(|now| format!("expired {} s ago", now - end));
    assert!(
        texts.any(|text| expired.text.contains(&text)),
        "{}",
        expired.text
    );
    refused(&order(&signer, 3, |o| o.not_before += 60), "begins in");
    refused(
        &order(&signer, 4, |o| o.not_after += 100_000),
        "longer than 86400 s",
    );
    refused(
        &order(&signer, 5, |o| o.action = Action::Back { no_server: false }),
        "no right `push`",
    );
    refused(&order(&signer, 6, |o| o.nonce = "no".to_owned()), "nonce");
    refused(&order(&keys().0, 7, |_| ()), "does not list");
    let good = order(&signer, 8, |_| ());
    let text = String::from_utf8(good.clone()).unwrap();
    for (from, to) in [("m1", "m3"), ("not_before", "not_befor3")] {
        assert!(text.contains(from));
        refused(text.replace(from, to).as_bytes(), "wrong signature");
    }
    refused(b"{}", "not an order");
    // None of them is remembered.
    let log = fs::read_to_string(folder.path().join("orders/orders.jsonl")).unwrap();
    assert_eq!(log, "");
    refused(&vec![b' '; 70_000], "longer than");
}

#[test]
fn an_order_is_executed_once_also_after_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let (signer, pair) = keys();
    let table = [key(&pair, &[Right::Start])];
    let first = order(&signer, 1, |_| ());
    let executed = executor(folder.path(), &table);
    assert!(!executed.receive(&first).repeated);
    let reply = outcome(&executed, &first);
    // There is no server.
    assert_eq!(reply.status, Status::Refused, "{}", reply.text);
    assert!(reply.text.contains("cannot connect"), "{}", reply.text);
    assert!(reply.repeated);
    let same_nonce = order(&signer, 1, |o| o.not_after += 1);
    assert!(
        executed
            .receive(&same_nonce)
            .text
            .contains("used by another order")
    );
    drop(executed);
    let again = executor(folder.path(), &table);
    assert_eq!(again.receive(&first), reply);
    let log = fs::read_to_string(folder.path().join("orders/orders.jsonl")).unwrap();
    assert!(log.contains("\"sender\":\"anna\""), "{log}");
}
