//! The token of `ecaxis serve`.

use std::os::unix::fs::PermissionsExt;

use ecaxis_test_support::program;

/// A token that other users can read is none.
#[test]
fn a_token_file_of_other_users_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("token");
    std::fs::write(&path, "0123456789abcdef0123\n").expect("written");
    let text = path.to_str().expect("UTF-8");
    let socket = folder.path().join("s.sock");
    let socket = socket.to_str().expect("UTF-8");
    for mode in [0o644, 0o660, 0o602] {
        let permissions = std::fs::Permissions::from_mode(mode);
        std::fs::set_permissions(&path, permissions).expect("set");
        let ran = program::run([
            "serve",
            "configs/demo.toml",
            "--sim",
            "--socket",
            socket,
            "--http",
            "127.0.0.1:0",
            "--token-file",
            text,
        ])
        .exits(2);
        assert!(
            ran.err.contains("other users may read or write it"),
            "{}",
            ran.err
        );
        assert!(ran.err.contains("chmod 600"), "{}", ran.err);
    }
}

/// Who knows a token that permits reading must not know the other one.
#[test]
fn both_tokens_differ() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("token");
    std::fs::write(&path, "0123456789abcdef0123\n").expect("written");
    let permissions = std::fs::Permissions::from_mode(0o600);
    std::fs::set_permissions(&path, permissions).expect("set");
    let token = path.to_str().expect("UTF-8");
    let socket = folder.path().join("s.sock");
    let socket = socket.to_str().expect("UTF-8");
    let both = ["--token-file", token, "--watch-token-file", token];
    let serve = ["serve", "configs/demo.toml", "--sim", "--socket", socket];
    let ran = program::run([&serve[..], &["--http", "127.0.0.1:0"], &both].concat()).exits(2);
    assert!(ran.err.contains("the same token"), "{}", ran.err);
}
