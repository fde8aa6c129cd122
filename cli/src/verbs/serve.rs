//! `ecaxis serve`: keeps a machine up for other programs and for people with a browser.

use std::io::Write as _;
use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::change_log::ChangeLog;
use ecaxis_master::clock::Clock;
use ecaxis_master::config::duration;
use ecaxis_master::session::Options;
use ecaxis_server::http::HttpOptions;
use ecaxis_server::serve::{ServeError, ServerOptions, new_token, serve};

use crate::access::{rights, signals};
use crate::args::bus::BusArgs;
use crate::args::files::{Inputs, check_output};
use crate::args::{LogArgs, Verbosity};
use crate::hints::{self, Failure};
use crate::render::note;

const EXAMPLES: &str = "\
Examples:
  ecaxis serve m.toml                            commands over a Unix socket
  ecaxis serve m.toml --http 127.0.0.1:8080      the page, read only
  ecaxis serve m.toml --sim --http 127.0.0.1:0 --control
                                                 the page, with commands
  ecaxis serve m.toml --record run.mcap          every cycle for other viewers
  ecaxis serve m.toml --sim --virtual --socket t.sock
                                                 for tests: time advances on
                                                 request

docs/server.md describes the protocol. Ctrl-C, SIGTERM, or a terminal that
closes: the axes decelerate within their limits, lose power, and the bus goes
back to Init.";

/// Keep a machine up, commanded and watched by other programs and in a browser
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Machine file
    #[arg(value_name = "FILE")]
    file: PathBuf,
    #[command(flatten)]
    bus: BusArgs,
    /// Let time advance only as clients ask (simulated bus only)
    #[arg(long = "virtual")]
    virtual_time: bool,
    /// Seed of the simulated bus
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Control socket [default: NAME.sock in $RUNTIME_DIRECTORY, /run/ecaxis or
    /// $XDG_RUNTIME_DIR/ecaxis]
    #[arg(long, value_name = "PATH")]
    socket: Option<PathBuf>,
    /// File mode of the socket, octal: who may write to it may command the machine
    #[arg(long, value_name = "MODE", default_value = "660", value_parser = mode)]
    socket_mode: u32,
    /// Serve the page, HTTP and WebSocket at this address; port 0: a free one
    #[arg(long, value_name = "ADDRESS:PORT")]
    http: Option<SocketAddr>,
    /// Let HTTP clients with the token command the machine
    #[arg(long, requires = "http")]
    control: bool,
    /// File with the token; without it, a new token at each start
    #[arg(long, value_name = "FILE", requires = "http")]
    token_file: Option<PathBuf>,
    /// File with a token that permits reading only
    #[arg(long, value_name = "FILE", requires = "token_file")]
    watch_token_file: Option<PathBuf>,
    /// A further name by which clients reach the server
    #[arg(long, value_name = "NAME", requires = "http")]
    allow_host: Vec<String>,
    /// Folder with the recordings that the page lists
    #[arg(long, value_name = "FOLDER", requires = "http")]
    recordings: Option<PathBuf>,
    /// Record every cycle to this MCAP file
    #[arg(long, value_name = "FILE.mcap")]
    record: Option<PathBuf>,
    /// Overwrite an existing recording
    #[arg(long, requires = "record")]
    force: bool,
    /// Keep the samples of every cycle for this time
    #[arg(long, value_name = "DURATION", default_value = "60s", value_parser = duration::parse)]
    keep: u64,
    #[command(flatten)]
    pub log: LogArgs,
    #[command(flatten)]
    pub verbosity: Verbosity,
}

fn mode(text: &str) -> Result<u32, String> {
    match u32::from_str_radix(text, 8) {
        Ok(mode) if mode <= 0o777 => Ok(mode),
        _ => Err("write an octal mode such as 660".to_owned()),
    }
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let loaded = args.bus.load(&args.file);
    let machine = loaded.map_err(|error| hints::config(&args.file, &error))?;
    let nic = machine.bus.nic.clone();
    let needs_sim = [
        (args.virtual_time, "--virtual"),
        (args.seed.is_some(), "--seed"),
    ];
    let faults = args.bus.script(&machine, &needs_sim)?;
    if let Some(path) = &args.record {
        let inputs = Inputs::from_machine(&machine)
            .with("the fault script", &args.bus.faults)
            .with("the file with the token", &args.token_file)
            .with("the file with the watch token", &args.watch_token_file);
        check_output("--record", path, args.force, &inputs)?;
    }
    let http = args.http.map(|address| http(args, address)).transpose()?;
    let options = ServerOptions {
        socket: Some((socket(args)?, args.socket_mode)),
        http,
        keep_ns: args.keep,
        change_log: ChangeLog::of_environment(),
        record: args.record.clone(),
    };
    let needed = rights::of_machine(&machine);
    let sockets = options.socket.iter().map(|(path, _)| path);
    let mut needed = rights::with_outputs(needed, sockets.chain(&args.record));
    needed.read.extend(args.recordings.clone());
    needed.one_bring_up = false;
    needed.low_port |= args.http.is_some_and(rights::is_low);
    rights::limit(&needed)?;
    let defaults = Options::default();
    let run_options = Options {
        clock: match args.virtual_time {
            true => Clock::Virtual,
            false => Clock::Real,
        },
        seed: args
            .seed
            .or(faults.as_ref().and_then(|faults| faults.seed))
            .unwrap_or(defaults.seed),
        faults,
        ..defaults
    };
    let stop = Arc::<CancelToken>::default();
    signals::stop_on_interrupt(&stop);
    let describe = Box::new(move |error: &_| {
        let failure = hints::failure(error, &nic);
        (failure.message, failure.hints.into_iter().next())
    });
    let served = serve(
        machine,
        run_options,
        options,
        &stop,
        describe,
        |listening| {
            if let Some(path) = &listening.socket {
                note(&format!("socket: {}", path.display()));
            }
            if let Some(url) = &listening.url {
                // Ignored: without a reader of the address, the server still serves.
                let mut out = std::io::stdout().lock();
                let _ = writeln!(out, "{url}").and_then(|()| out.flush());
                if let Some(file) = &args.token_file {
                    let file = file.display();
                    note(&format!("to command, add #token= and the token of {file}"));
                }
            }
        },
    );
    served.map_err(|error| {
        let hint = match &error {
            ServeError::Socket { .. } => "name another file with --socket",
            ServeError::Http { .. } => "name another address with --http, or port 0",
            ServeError::Memory(_) => "keep fewer samples with --keep",
            ServeError::Thread(_) => "end other programs",
            ServeError::Record(_) => "name a file with --record on a disk with enough space",
        };
        let code = match &error {
            ServeError::Record(_) => hints::FAILED,
            _ => hints::WRONG,
        };
        Failure::new(code, error.to_string()).hint(hint)
    })
}

/// Returns the settings of the HTTP server.
fn http(args: &Args, address: SocketAddr) -> Result<HttpOptions, Failure> {
    let token = match &args.token_file {
        Some(path) => token(path)?,
        None if !address.ip().is_loopback() => {
            let message = format!("{address} is reachable by other computers without a token");
            return Err(Failure::new(hints::WRONG, message).hint(
                "write a secret of 16 characters or more to a file, and name it with --token-file",
            ));
        }
        None => new_token().map_err(|error| {
            Failure::new(
                hints::FAILED,
                format!("the system has no random numbers: {error}"),
            )
        })?,
    };
    let watch_token = args.watch_token_file.as_deref().map(self::token);
    let watch_token = watch_token.transpose()?;
    if watch_token.as_ref() == Some(&token) {
        let message = "both token files contain the same token";
        let hint = "write another secret to the file of --watch-token-file";
        return Err(Failure::new(hints::WRONG, message).hint(hint));
    }
    Ok(HttpOptions {
        address,
        control: args.control,
        token,
        watch_token,
        known_token: args.token_file.is_some(),
        hosts: args.allow_host.clone(),
        recordings: args.recordings.clone(),
    })
}

fn token(path: &Path) -> Result<String, Failure> {
    const MAX_BYTES: u64 = 4096;
    let wrong = |why: String| {
        Failure::new(hints::WRONG, format!("{}: {why}", path.display()))
            .hint("write one line with 16 or more letters and digits")
    };
    let about = std::fs::metadata(path).map_err(|e| wrong(e.to_string()))?;
    // The group may read it: that of a service.
    if about.permissions().mode() & 0o027 != 0 {
        let message = format!("{}: other users may read or write it", path.display());
        let hint = format!("chmod 600 {}", path.display());
        return Err(Failure::new(hints::WRONG, message).hint(hint));
    }
    let text = ecaxis_master::file::read_text(path, MAX_BYTES).map_err(|e| wrong(e.to_string()))?;
    let token = text.trim();
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.~".contains(c);
    if token.len() < 16 || !token.chars().all(plain) {
        return Err(wrong("is not a token".to_owned()));
    }
    Ok(token.to_owned())
}

/// Returns the path of the socket. Its folder exists then.
fn socket(args: &Args) -> Result<PathBuf, Failure> {
    if let Some(path) = &args.socket {
        return Ok(path.clone());
    }
    let name = Path::new(args.file.file_stem().unwrap_or_default()).with_extension("sock");
    // Of a systemd unit with RuntimeDirectory=.
    if let Some(folder) = std::env::var_os("RUNTIME_DIRECTORY") {
        return Ok(Path::new(&folder).join(name));
    }
    let folder = match rustix::process::geteuid().is_root() {
        true => PathBuf::from("/run"),
        false => std::env::var_os("XDG_RUNTIME_DIR")
            .map(PathBuf::from)
            .ok_or_else(|| {
                Failure::new(hints::WRONG, "XDG_RUNTIME_DIR is not set")
                    .hint("name the socket with --socket")
            })?,
    };
    let folder = folder.join("ecaxis");
    std::fs::create_dir_all(&folder).map_err(|error| {
        Failure::new(
            hints::WRONG,
            format!("cannot create {}: {error}", folder.display()),
        )
        .hint("name the socket with --socket")
    })?;
    Ok(folder.join(name))
}
