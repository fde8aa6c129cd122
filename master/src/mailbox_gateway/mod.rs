//! The mailbox gateway (ETG.8200): other vendors' tools reach the mailboxes of the devices over UDP
//! and TCP, and the object dictionary of the MainDevice (ETG.1510) at station address 0.
//!
//! The gateway has a thread of its own with a tokio runtime. It is one more user of [`Mailboxes`],
//! and it knows the cycle only from snapshots of the supervisor. May wait and allocate. Never panics
//! on data of a client or a device.
//!
//! | file | contents |
//! |---|---|
//! | `server.rs` | sockets, clients, their limits |
//! | `client.rs` | the telegrams of one client, and the devices reserved for its transfers |
//! | `access.rs` | what clients may not write |
//! | `dictionary.rs` | the objects of the MainDevice |
//! | `object.rs` | an object with its entries; CoE services for objects |
//! | `live.rs` | what the running machine publishes |

use std::io;
use std::net::{SocketAddr, TcpListener, UdpSocket};
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use tokio::sync::{oneshot, watch};

use crate::bringup::Bus;
use crate::config::{Machine, MailboxGatewaySetup};
use crate::mailbox::Mailboxes;
use crate::sys::rights;

mod access;
mod client;
mod dictionary;
mod live;
mod object;
mod server;

pub(crate) use live::LivePublisher;

/// How often a free port is looked for, if the machine file names port 0.
const PORTS: u32 = 16;

/// What the clients have in common.
#[derive(Debug)]
struct Gateway {
    mailboxes: Mailboxes,
    access: access::Access,
    dictionary: dictionary::Dictionary,
}

/// The sockets of a gateway that does not answer yet.
#[derive(Debug)]
pub(crate) struct BoundGateway {
    setup: MailboxGatewaySetup,
    tcp: TcpListener,
    udp: UdpSocket,
}

/// The thread of a gateway. It ends with the [`LivePublisher`].
#[derive(Debug)]
pub(crate) struct GatewayThread(Option<JoinHandle<()>>);

impl BoundGateway {
    /// Binds UDP and TCP to the same port.
    pub(crate) fn bind(setup: MailboxGatewaySetup) -> io::Result<Self> {
        let mut left = PORTS;
        loop {
            let tcp = TcpListener::bind(setup.bind)?;
            match UdpSocket::bind(tcp.local_addr()?) {
                Ok(udp) => {
                    tcp.set_nonblocking(true)?;
                    udp.set_nonblocking(true)?;
                    return Ok(Self { setup, tcp, udp });
                }
                // Another program has this port of UDP.
                Err(_) if setup.bind.port() == 0 && left > 0 => left -= 1,
                Err(error) => return Err(error),
            }
        }
    }

    pub(crate) fn address(&self) -> io::Result<SocketAddr> {
        self.tcp.local_addr()
    }

    pub(crate) fn write(&self) -> bool {
        self.setup.write
    }

    /// Starts to answer.
    pub(crate) fn serve(
        self,
        machine: &Machine,
        bus: &Bus,
        mailboxes: Mailboxes,
    ) -> io::Result<(GatewayThread, LivePublisher)> {
        let (status, published) = watch::channel(live::Live::default());
        let (end, ended) = oneshot::channel();
        let gateway = Arc::new(Gateway {
            access: access::Access::new(machine, self.setup.write, published.clone()),
            dictionary: dictionary::Dictionary::new(
                machine,
                &bus.devices,
                &bus.places(),
                &mailboxes,
                published,
            ),
            mailboxes,
        });
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()?;
        let Self { tcp, udp, .. } = self;
        let work = move || {
            rights::drop_capabilities();
            runtime.block_on(async {
                tokio::select! {
                    _ = ended => {}
                    served = server::serve(&gateway, tcp, udp) => {
                        if let Err(error) = served {
                            tracing::error!(%error, "the mailbox gateway has ended");
                        }
                    }
                }
            });
        };
        let thread = thread::Builder::new().name("ecaxis-gateway".to_owned());
        let thread = GatewayThread(Some(thread.spawn(work)?));
        Ok((thread, LivePublisher::new(status, end, bus.image.frames())))
    }
}

/// Waits for the end of the thread: the port is free then.
impl Drop for GatewayThread {
    fn drop(&mut self) {
        if let Some(thread) = self.0.take() {
            // A panic was reported on stderr; the machine does not depend on this thread.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests;
