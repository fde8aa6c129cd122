//! The commands that send orders, and those for bundles.

use std::io::Write;
use std::path::PathBuf;

use clap::{Args, Subcommand};
use serde_json::json;

use super::bundle::{self, Bundle};
use super::executor::unix_time;
use super::files;
use super::manifest::{BundlePath, FileRef, MAX_FILE};
use super::order::{Action, OrderReply, Status};
use super::sender::OrderSender;
use super::signing::{KeyTable, Keyring, MAX_SIGNATURE, Right, Signer};
use crate::error::{Error, Result};
use crate::keys::MachineId;
use crate::options::Network;
use crate::session;

/// The secret key of minisign that signs.
#[derive(Debug, Clone, Args)]
pub struct KeyArgs {
    /// Secret key of minisign
    #[arg(long, value_name = "FILE", env = "ECAXIS_FLEET_KEY")]
    key: PathBuf,
    /// File with the password of the key; without it, the terminal asks
    #[arg(long, value_name = "FILE")]
    password_file: Option<PathBuf>,
}

impl KeyArgs {
    pub(super) fn load(&self) -> Result<Signer> {
        Signer::load(&self.key, self.password_file.as_deref())
    }
}

#[derive(Debug, Subcommand)]
pub enum BundleAction {
    /// Collect the files of a machine file in a new folder
    #[command(after_help = "Examples:\n  ecaxis-fleet bundle make machine.toml \
                            press.bundle --machine hall-1/press-3\n  \
                            minisign -Sm press.bundle/manifest.json -s release.key")]
    Make {
        /// Machine file
        file: PathBuf,
        /// New folder
        folder: PathBuf,
        /// The machine for which the bundle is
        #[arg(long, value_name = "SITE/MACHINE")]
        machine: MachineId,
        /// The program ecaxis, which checks the files
        #[arg(long, default_value = "ecaxis")]
        ecaxis: String,
    },
    /// Sign a bundle, as `minisign -Sm FOLDER/manifest.json` does
    #[command(after_help = "Examples:\n  ecaxis-fleet bundle sign press.bundle \
                            --key release.key")]
    Sign {
        folder: PathBuf,
        #[command(flatten)]
        key: KeyArgs,
    },
    /// Verify the signature and the files of a bundle
    #[command(after_help = "Examples:\n  ecaxis-fleet bundle verify press.bundle \
                            --public RWQf6LRC...")]
    Verify {
        folder: PathBuf,
        /// The second line of the public key's file
        #[arg(long, value_name = "KEY")]
        public: String,
    },
}

/// Makes, signs or verifies a bundle.
///
/// # Errors
/// Fails if a file has a problem or the signature is wrong.
pub fn bundle(action: BundleAction) -> Result<()> {
    match action {
        BundleAction::Make {
            file,
            folder,
            machine,
            ecaxis,
        } => {
            let made = bundle::make(&ecaxis, machine, &file, &folder, unix_time(), None)?;
            print(&format!("{} files, not signed", made.files.len()))
        }
        BundleAction::Sign { folder, key } => bundle::sign(&folder, unix_time(), &key.load()?),
        BundleAction::Verify { folder, public } => {
            let bundle = Bundle::open(&folder)?;
            let key = KeyTable {
                name: "--public".to_owned(),
                public,
                rights: vec![Right::Bundle],
            };
            let keys = Keyring::new(&[key])?;
            keys.verify("the bundle", &bundle.text, &bundle.signature)?;
            bundle.contents()?;
            let count = bundle.manifest.files.len();
            print(&format!(
                "{}: {count} files, signature verified",
                bundle.manifest.machine
            ))
        }
    }
}

#[derive(Debug, Args)]
pub struct PushArgs {
    #[command(flatten)]
    network: Network,
    /// The machine
    #[arg(value_name = "SITE/MACHINE")]
    machine: MachineId,
    /// Folder of a signed bundle
    #[arg(required_unless_present = "back")]
    bundle: Option<PathBuf>,
    /// Go back to the previous bundle
    #[arg(long, conflicts_with = "bundle")]
    back: bool,
    /// The machine has no server now, as before its first bundle
    #[arg(long)]
    no_server: bool,
    #[command(flatten)]
    key: KeyArgs,
}

/// Sends a bundle to a machine, or the machine back to its previous bundle.
///
/// # Errors
/// Fails with the reason of the machine.
pub async fn push(args: PushArgs) -> Result<()> {
    let signer = args.key.load()?;
    let bundle = args.bundle.as_deref().map(Bundle::open).transpose()?;
    let contents = bundle.as_ref().map_or(Ok(Vec::new()), Bundle::contents)?;
    let session = session::open_at_once(&args.network).await?;
    let sender = OrderSender::new(session, signer);
    let mut served = contents;
    let action = match bundle {
        Some(bundle) => {
            served.push(bundle.text.clone());
            Action::Push {
                manifest: FileRef::of(&bundle.text),
                signature: bundle.signature,
                no_server: args.no_server,
            }
        }
        None => Action::Back {
            no_server: args.no_server,
        },
    };
    let _files = sender.serve(&args.machine, served).await?;
    let machine = args.machine.to_string();
    let reply = sender
        .send(&args.machine, action, &mut progress(machine.clone()))
        .await?;
    succeed(&machine, &reply)
}

/// A machine and devices of it, in their order.
#[derive(Debug, Clone)]
struct UpdateTarget {
    machine: MachineId,
    devices: Vec<String>,
}

impl std::str::FromStr for UpdateTarget {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let (machine, devices) = text
            .split_once(':')
            .ok_or("write SITE/MACHINE:DEVICE,DEVICE")?;
        let devices: Vec<String> = devices.split(',').map(str::to_owned).collect();
        match devices.iter().any(String::is_empty) {
            true => Err("write SITE/MACHINE:DEVICE,DEVICE".to_owned()),
            false => Ok(Self {
                machine: machine.parse()?,
                devices,
            }),
        }
    }
}

#[derive(Debug, Args)]
pub struct UpdateArgs {
    #[command(flatten)]
    network: Network,
    /// Firmware file, or a file of `ecaxis sdo dump` with `--parameters`
    file: PathBuf,
    /// The machines and their devices, in the order of the update
    #[arg(value_name = "SITE/MACHINE:DEVICE,...", required = true)]
    targets: Vec<UpdateTarget>,
    /// The file has parameters, not firmware
    #[arg(long)]
    parameters: bool,
    /// Print a JSON object per device
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    key: KeyArgs,
}

/// Updates device by device, and stops at the first that is refused or fails.
///
/// # Errors
/// Fails at the first device, with its place.
pub async fn update(args: UpdateArgs) -> Result<()> {
    let signer = args.key.load()?;
    let bytes = files::read(&args.file, MAX_FILE)?;
    let name = args
        .file
        .file_name()
        .and_then(|name| name.to_str())
        .unwrap_or_default();
    let name = BundlePath::try_from(name.to_owned()).map_err(Error::new)?;
    let signature = super::signature_path(&args.file);
    let signature = match signature.exists() {
        true => {
            let text = files::read(&signature, MAX_SIGNATURE as u64)?;
            let text = String::from_utf8(text);
            Some(text.map_err(|_| Error::new("the signature of the file is not a text"))?)
        }
        false => None,
    };
    let file = FileRef::of(&bytes);
    let session = session::open_at_once(&args.network).await?;
    let sender = OrderSender::new(session, signer);
    let all: usize = args.targets.iter().map(|target| target.devices.len()).sum();
    let mut done = 0;
    for UpdateTarget { machine, devices } in &args.targets {
        let _files = sender.serve(machine, vec![bytes.clone()]).await?;
        for device in devices {
            let place = format!("{machine}:{device}");
            let (device, name) = (device.clone(), name.clone());
            let action = match args.parameters {
                true => Action::Parameters { device, name, file },
                false => Action::Firmware {
                    device,
                    name,
                    file,
                    signature: signature.clone(),
                },
            };
            let reply = sender
                .send(machine, action, &mut progress(place.clone()))
                .await;
            if args.json {
                let reply = reply.as_ref();
                let status = reply.map_or(json!("silent"), |reply| json!(reply.status));
                let text = reply.map_or_else(ToString::to_string, |reply| reply.text.clone());
                print(&json!({"device": place, "status": status, "text": text}).to_string())?;
            }
            let ended = match reply {
                Ok(reply) if args.json && reply.status == Status::Done => Ok(()),
                Ok(reply) => succeed(&place, &reply),
                Err(error) => Err(error),
            };
            ended.map_err(|error| {
                let (text, rest) = (error.to_string(), all - done - 1);
                let (what, help) = text.split_once("\nhelp: ").unwrap_or((&text, ""));
                let at = format!("stopped at device {} of {all}", done + 1);
                let error = Error::new(format!("{what}\n{at}: {done} done, {rest} not touched"));
                let again = "then repeat this command: it skips what is done";
                error.help(match help.is_empty() {
                    true => format!("repair it; {again}"),
                    false => help.replace("send the update again", "repeat this command"),
                })
            })?;
            done += 1;
        }
    }
    match args.json {
        true => Ok(()),
        false => print(&format!("{done} of {all} devices done")),
    }
}

/// Reports the steps of an order on standard error.
pub(super) fn progress(name: String) -> impl FnMut(&str) + Send {
    let mut last = String::new();
    move |text| {
        // The counts of a transfer change with each answer.
        let step = text.split(':').next().unwrap_or_default();
        if step != last {
            last = step.to_owned();
            let _ = writeln!(std::io::stderr(), "{name}: {text}");
        }
    }
}

pub(super) fn succeed(name: &str, reply: &OrderReply) -> Result<()> {
    let with = |word: &str| {
        let (what, help) = reply
            .text
            .split_once("\nhelp: ")
            .unwrap_or((&reply.text, ""));
        let error = Error::new(format!("{name}: {word}: {what}"));
        if help.is_empty() {
            error
        } else {
            error.help(help)
        }
    };
    match reply.status {
        Status::Refused => Err(with("refused")),
        Status::Failed => Err(with("failed")),
        Status::Done | Status::Started | Status::Running => {
            print(&format!("{name}: {}", reply.text))
        }
    }
}

fn print(text: &str) -> Result<()> {
    let written = writeln!(std::io::stdout(), "{text}");
    written.map_err(|e| Error::new(format!("standard output: {e}")))
}
