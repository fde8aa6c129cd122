//! The binary `ecaxis`.

#![allow(
    clippy::disallowed_types,
    clippy::disallowed_methods,
    clippy::disallowed_macros,
    reason = "only the library's real-time folder is bound by clippy.toml"
)]

mod cli;

fn main() -> std::process::ExitCode {
    cli::main()
}
