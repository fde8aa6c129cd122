//! The mailbox gateway (ETG.8200) for other vendors' tools.

use std::net::{Ipv4Addr, SocketAddr};

use ecaxis_ecat::mailbox::gateway::PORT;

use super::fields::KeyExt as _;
use super::problem::Problems;
use super::raw::RawMailboxGateway;

/// Settings of the mailbox gateway.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MailboxGatewaySetup {
    /// The address of UDP and TCP.
    pub bind: SocketAddr,
    /// `true` if clients may write.
    pub write: bool,
}

pub(super) fn check(raw: &RawMailboxGateway, p: &mut Problems<'_>) -> MailboxGatewaySetup {
    let mut bind = SocketAddr::from((Ipv4Addr::LOCALHOST, PORT));
    if let Some(text) = &raw.bind {
        match text.get_ref().parse() {
            Ok(address) => bind = address,
            Err(_) => {
                let message = format!("\"{}\" is not an IP address with a port", text.get_ref());
                let hint = "write `bind = \"127.0.0.1:34980\"` for programs of this computer";
                p.add_hint(text.span(), message, hint);
            }
        }
    }
    MailboxGatewaySetup {
        bind,
        write: raw.write.value().unwrap_or(false),
    }
}
