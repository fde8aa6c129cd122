use proptest::prelude::*;

use super::*;

// The example of the crate's documentation: a signature of `test` in a file of this name.
const PUBLIC: &str = "RWQf6LRCGA9i53mlYecO4IzT51TGPpvWucNSCh1CBM0QTaLn73Y7GFO3";
const SIGNATURE: &str = "untrusted comment: signature from minisign secret key
RUQf6LRCGA9i559r3g7V1qNyJDApGip8MfqcadIgT9CuhV3EMhHoN1mGTkUidF/z7SrlQgXdy8ofjb7bNJJylDOocrCo8KLzZwo=
trusted comment: timestamp:1633700835\tfile:test\tprehashed
wLMDjy9FLAuxZ3q4NlEvkgtyhrr0gtTu6KC4KBJdITbbOeAi1zBIYo0v4iTgt8jJpIidRJnp94ABQkJAgAooBQ==
";

fn policy(lines: &str) -> SignaturePolicy {
    let key = format!("{lines}\n[[key]]\nname = 'us'\npublic = '{PUBLIC}'\n");
    SignaturePolicy::parse(&key).unwrap()
}

/// Verifies `test` in a file of the given name with the given signature.
fn verify(policy: &SignaturePolicy, name: &str, signature: &[u8]) -> Result<UsedFile, Refusal> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(folder.path().join(format!("{name}.minisig")), signature).unwrap();
    let verified = policy.verify(SignedKind::Esi, &path, b"test");
    verified.map_err(|error| error.why)
}

#[test]
fn a_signature_counts_for_its_bytes_name_and_time() {
    let used = verify(&policy(""), "test", SIGNATURE.as_bytes()).unwrap();
    assert_eq!(used.signed_by.as_deref(), Some("us (E7620F1842B4E81F)"));
    let refused = verify(&policy(""), "other", SIGNATURE.as_bytes()).unwrap_err();
    assert!(matches!(refused, Refusal::OtherFile(name) if name == "test"));
    let at = |time: u64| policy(&format!("not_before = {time}"));
    assert!(verify(&at(1_633_700_835), "test", SIGNATURE.as_bytes()).is_ok());
    let refused = verify(&at(1_633_700_836), "test", SIGNATURE.as_bytes()).unwrap_err();
    assert!(matches!(refused, Refusal::TooOld));
    let later = SIGNATURE.replace("1633700835", "1933700835");
    let refused = verify(&at(1_633_700_836), "test", later.as_bytes()).unwrap_err();
    assert!(matches!(refused, Refusal::Changed), "{refused:?}");
}

#[test]
fn only_a_required_signature_may_not_be_missing() {
    let missing = |policy: &SignaturePolicy, kind| policy.verify(kind, Path::new("no"), b"test");
    let strict = policy("require = ['tables', 'firmware']");
    for kind in [SignedKind::Machine, SignedKind::Esi] {
        assert_eq!(missing(&strict, kind).unwrap().signed_by, None);
    }
    for kind in [SignedKind::Tables, SignedKind::Firmware] {
        let error = missing(&strict, kind).unwrap_err();
        assert!(matches!(error.why, Refusal::Missing(what) if what == kind));
    }
    assert!(missing(&SignaturePolicy::default(), SignedKind::Machine).is_ok());
}

#[test]
fn policies_with_mistakes_are_refused() {
    let key = format!("[[key]]\nname = 'us'\npublic = '{PUBLIC}'\n");
    for (text, why) in [
        ("require = ['machine']", "needs a [[key]]"),
        ("require = ['machines']", "machines"),
        ("requires = ['machine']", "requires"),
        ("[[key]]\nname = 'us'", "public"),
        ("[[key]]\nname = 'us'\npublic = 'RWQf'", "not a public key"),
        (
            &key.replace("RWQ", "RUX"),
            "`us` is not a public key of minisign",
        ),
        (&key.replace("name", "nam"), "nam"),
        ("not_before = -1", "not_before"),
    ] {
        let refused = SignaturePolicy::parse(text).unwrap_err();
        assert!(refused.contains(why), "{text}: {refused}");
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("policy.toml");
    std::fs::write(&path, &key).unwrap();
    let set = |mode| std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode));
    for (mode, good) in [(0o644, true), (0o664, false), (0o646, false)] {
        set(mode).unwrap();
        assert_eq!(SignaturePolicy::load(&path).is_ok(), good, "{mode:o}");
    }
    assert!(SignaturePolicy::load(folder.path()).is_err());
}

#[test]
fn every_changed_character_of_a_signature_is_refused() {
    let policy = policy("");
    let begin = SIGNATURE.find('\n').unwrap() + 1;
    let mut text = SIGNATURE.as_bytes().to_vec();
    for at in begin..text.len() - 1 {
        text[at] ^= 1;
        assert!(verify(&policy, "test", &text).is_err(), "byte {at}");
        text[at] ^= 1;
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn hostile_signatures_and_policies_are_refused(
        lines in proptest::collection::vec("[ -~\t\u{0}é]{0,120}", 0..6),
        bytes in proptest::collection::vec(any::<u8>(), 0..200),
        at in 0..SIGNATURE.len(),
    ) {
        let policy = policy("");
        let text = lines.join("\n");
        prop_assert!(verify(&policy, "test", text.as_bytes()).is_err());
        prop_assert!(verify(&policy, "test", &bytes).is_err());
        // The last byte is a line feed, which may be missing.
        if at + 1 < SIGNATURE.len() {
            prop_assert!(verify(&policy, "test", &SIGNATURE.as_bytes()[..at]).is_err());
        }
        let _ = key_id(&text);
        let _ = SignaturePolicy::parse(&text);
    }
}
