//! The port of the operating system.

use std::convert::Infallible;
use std::time::Duration;

use ecaxis_ecat::mailbox::eoe::MAX_FRAME;

use super::{EoeNetwork, EthernetInterface, HostPort};
use crate::clock::{self, Nanos};
use crate::sys::tap::TapInterface;

/// The period at which the interface is read. Reading costs one system call.
const PERIOD: Duration = Duration::from_millis(1);
/// The maximum number of frames per period from the interface; further ones wait in its own queue.
const FRAMES_PER_PERIOD: usize = 16;

/// The virtual switch of a run, and the interface at its last port.
#[derive(Debug)]
pub struct Ethernet {
    pub(crate) network: EoeNetwork,
    host: Option<(Box<dyn EthernetInterface>, HostPort)>,
}

impl Ethernet {
    /// Adds the interface, if there is one, under this name.
    pub(crate) fn new(
        network: EoeNetwork,
        interface: Option<Box<dyn EthernetInterface>>,
        name: &str,
    ) -> Self {
        let host = interface.map(|interface| (interface, network.add_host(name)));
        Self { network, host }
    }

    /// Returns the work between the interface and its port, once.
    pub(crate) fn serve(&mut self) -> impl Future<Output = Infallible> + use<> {
        let host = self.host.take();
        async move {
            match host {
                Some((interface, port)) => serve(interface, port).await,
                None => std::future::pending().await,
            }
        }
    }
}

impl EthernetInterface for TapInterface {
    fn receive(&mut self, _: Nanos, buffer: &mut [u8]) -> Option<usize> {
        Self::receive(self, buffer)
    }

    fn send(&mut self, _: Nanos, frame: &[u8]) -> bool {
        Self::send(self, frame)
    }
}

/// Passes frames between an interface and its port.
async fn serve(mut interface: Box<dyn EthernetInterface>, port: HostPort) -> Infallible {
    // A frame that fills the buffer is too long for the switch.
    let mut buffer = vec![0; MAX_FRAME + 1];
    loop {
        let now = clock::now();
        for _ in 0..FRAMES_PER_PERIOD {
            let Some(length) = interface.receive(now, &mut buffer) else {
                break;
            };
            port.receive(now, buffer.get(..length).unwrap_or_default());
        }
        while let Some(frame) = port.next_frame() {
            port.count(interface.send(now, &frame));
        }
        clock::delay(PERIOD).await;
    }
}
