//! Tests of the library with temporary folders.

use std::time::{Duration, SystemTime};

use tempfile::TempDir;

use super::*;

fn esi(product: u32, revision: u32) -> String {
    format!(
        "<EtherCATInfo><Vendor><Id>1</Id></Vendor><Descriptions><Devices><Device>\
         <Type ProductCode=\"{product}\" RevisionNo=\"#x{revision:08x}\">T{product}</Type>\
         </Device></Devices></Descriptions></EtherCATInfo>"
    )
}

/// Writes a file with a modification time `age` seconds ago.
fn put(folder: &TempDir, name: &str, text: &str, age: u64) {
    let path = folder.path().join(name);
    std::fs::create_dir_all(path.parent().expect("a folder")).expect("made");
    std::fs::write(&path, text).expect("written");
    let time = SystemTime::now() - Duration::from_secs(age);
    let file = std::fs::File::options().write(true).open(&path);
    file.and_then(|file| file.set_modified(time))
        .expect("dated");
}

fn folder() -> TempDir {
    tempfile::tempdir().expect("a temporary folder")
}

fn revisions(library: &Library) -> Vec<(u32, u32)> {
    let entries = library.entries().iter();
    entries.map(|e| (e.product, e.revision)).collect()
}

#[test]
fn revision_rules_accept_the_documented_revisions() {
    let files = folder();
    for (n, revision) in [0x0001_0002, 0x0001_0005, 0x0003_0002]
        .into_iter()
        .enumerate()
    {
        put(&files, &format!("{n}.xml"), &esi(7, revision), 60);
    }
    let library = Library::open(files.path(), None).expect("a folder");
    let rules = [
        RevisionMatch::Equal,
        RevisionMatch::Newer,
        RevisionMatch::HighWord,
        RevisionMatch::LowWord,
    ];
    for (found, expected) in [
        (0x0001_0005, [Some(0x0001_0005); 4]),
        (
            0x0001_0007,
            [None, Some(0x0001_0005), Some(0x0001_0005), None],
        ),
        (0x0001_0001, [None, None, Some(0x0001_0002), None]),
        (
            0x0002_0002,
            [None, Some(0x0001_0005), None, Some(0x0001_0002)],
        ),
        (0x0000_0002, [None, None, None, Some(0x0001_0002)]),
        (0x0009_0009, [None, Some(0x0003_0002), None, None]),
    ] {
        for (rule, expected) in rules.into_iter().zip(expected) {
            let device = esi::Identity {
                vendor: 1,
                product: 7,
                revision: found,
            };
            let best = library.find(device, rule).map(|e| e.revision);
            assert_eq!(best, expected, "{found:08x} {rule}");
        }
    }
}

#[test]
fn library_reads_only_changed_files_again() {
    let (files, cache) = (folder(), folder());
    let index = cache.path().join("sub/index.json");
    let open = || Library::open(files.path(), Some(&index)).expect("a folder");
    put(&files, "a.xml", &esi(1, 1), 60);
    put(&files, "deep/b.XML", &esi(2, 1), 60);
    put(&files, "c.xml", "<html/>", 60);
    put(&files, "notes.txt", "no ESI", 60);
    let first = open();
    assert_eq!((first.files_read(), first.unusable().len()), (3, 1));
    let second = open();
    assert_eq!(second.files_read(), 0);
    assert_eq!(second.entries(), first.entries());
    assert_eq!(second.unusable(), first.unusable());
    // First the same length with another time, then the same time with another length.
    put(&files, "a.xml", &esi(3, 1), 50);
    assert_eq!(
        (open().files_read(), revisions(&open())),
        (1, vec![(2, 1), (3, 1)])
    );
    put(&files, "a.xml", &esi(1234, 1), 50);
    assert_eq!(
        (open().files_read(), revisions(&open())),
        (1, vec![(2, 1), (1234, 1)])
    );
    std::fs::remove_file(files.path().join("deep/b.XML")).expect("removed");
    assert_eq!(revisions(&open()), [(1234, 1)]);
    assert_eq!(open().files_read(), 0);
}

#[test]
fn library_reads_a_recently_written_file_again() {
    let (files, cache) = (folder(), folder());
    let index = cache.path().join("index.json");
    put(&files, "a.xml", &esi(1, 1), 0);
    for _ in 0..2 {
        let library = Library::open(files.path(), Some(&index)).expect("a folder");
        assert_eq!(library.files_read(), 1);
    }
}

/// A damaged index never changes the result.
#[test]
fn library_ignores_a_damaged_index() {
    let (files, cache) = (folder(), folder());
    let index = cache.path().join("index.json");
    put(&files, "a.xml", &esi(1, 1), 60);
    put(&files, "b.xml", "<no/>", 60);
    let right = Library::open(files.path(), Some(&index)).expect("a folder");
    let whole = std::fs::read(&index).expect("an index");
    let mut damaged: Vec<Vec<u8>> = vec![
        Vec::new(),
        b"{}".to_vec(),
        whole[..whole.len() / 2].to_vec(),
    ];
    for at in 0..whole.len() {
        let mut bytes = whole.clone();
        bytes[at] ^= 1;
        damaged.push(bytes);
    }
    let other = String::from_utf8_lossy(&whole).replacen(env!("CARGO_PKG_VERSION"), "0.0.0", 1);
    damaged.push(other.into_bytes());
    for bytes in damaged {
        std::fs::write(&index, &bytes).expect("written");
        let library = Library::open(files.path(), Some(&index)).expect("a folder");
        assert_eq!(library.entries(), right.entries());
        assert_eq!(library.unusable(), right.unusable());
        assert_eq!(
            library.files_read(),
            2,
            "{}",
            String::from_utf8_lossy(&bytes)
        );
    }
}

#[test]
fn library_opens_without_a_writable_index() {
    let (files, cache) = (folder(), folder());
    put(&files, "a.xml", &esi(1, 1), 60);
    std::fs::write(cache.path().join("file"), "").expect("written");
    let index = cache.path().join("file/index.json");
    for _ in 0..2 {
        let library = Library::open(files.path(), Some(&index)).expect("a folder");
        assert_eq!(revisions(&library), [(1, 1)]);
    }
}

#[test]
fn library_lists_a_device_of_two_files_twice_and_finds_it_once() {
    let files = folder();
    put(&files, "a.xml", &esi(1, 1), 60);
    put(&files, "b.xml", &esi(1, 1), 60);
    let library = Library::open(files.path(), None).expect("a folder");
    assert_eq!(revisions(&library), [(1, 1), (1, 1)]);
    let device = esi::Identity {
        vendor: 1,
        product: 1,
        revision: 1,
    };
    let found = library.find(device, RevisionMatch::Equal).expect("one");
    assert_eq!(found.file, Path::new("a.xml"));
}

#[test]
fn load_adds_modules_of_referenced_files() {
    let files = folder();
    let module =
        |ident: u32| format!("<Module><Type ModuleIdent=\"{ident}\">M{ident}</Type></Module>");
    let refers = |names: &[&str]| {
        let names = names.iter();
        let all: Vec<String> = names
            .map(|name| format!("<InfoReference>{name}</InfoReference>"))
            .collect();
        let head = format!("<EtherCATInfo>{}", all.concat());
        esi(1, 1).replace("<EtherCATInfo>", &head)
    };
    put(
        &files,
        "main.xml",
        &refers(&["Sub\\Modules.XML", "gone.xml", "main.xml", "broken.xml"]),
        60,
    );
    let modules = format!(
        "<EtherCATModule>{}{}</EtherCATModule>",
        module(1),
        module(2)
    );
    put(&files, "modules.xml", &modules, 60);
    put(&files, "broken.xml", "<EtherCATModule>", 60);
    let file = load(&files.path().join("main.xml"), &|_| true).expect("an ESI file");
    let idents: Vec<u32> = file.modules.iter().map(|m| m.ident).collect();
    assert_eq!(idents, [1, 2]);
    let reported: Vec<&str> = file.warnings.iter().map(|w| &*w.message).collect();
    assert_eq!(reported.len(), 2, "{reported:?}");
    assert!(
        reported
            .iter()
            .any(|t| t.contains("gone.xml") && t.contains("same folder")),
        "{reported:?}"
    );
    assert!(
        reported
            .iter()
            .any(|t| t.contains("broken.xml") && t.contains("ends inside")),
        "{reported:?}"
    );
}
