//! The IP host of a device: ARP, ICMP echo, and a web page over TCP port 80.

use std::collections::VecDeque;
use std::fmt;

use smoltcp::iface::{Config, Interface, SocketHandle, SocketSet};
use smoltcp::phy::{self, DeviceCapabilities, Medium};
use smoltcp::socket::{Socket, tcp};
use smoltcp::time::{Duration, Instant};
use smoltcp::wire::{EthernetAddress, IpCidr, Ipv4Cidr};

use super::message::Parameters;

/// Maximum bytes of an Ethernet frame of the host.
const MTU: usize = 1514;
/// Maximum number of frames between host and mailbox in each direction.
const FRAMES: usize = 16;
/// Connections at the same time.
const CONNECTIONS: usize = 8;
/// Maximum bytes of a request.
const REQUEST: usize = 1024;
/// Room for a page.
const PAGE: usize = 4096;
const HTTP: u16 = 80;
/// The longest pause in ns of a host with open connections.
const LONGEST_NS: u64 = 50_000_000;

/// The frames between the host and the mailbox.
#[derive(Default)]
struct Wire {
    arrived: VecDeque<Vec<u8>>,
    leaving: VecDeque<Vec<u8>>,
}

struct Arrived(Vec<u8>);

impl phy::RxToken for Arrived {
    fn consume<R, F: FnOnce(&[u8]) -> R>(self, work: F) -> R {
        work(&self.0)
    }
}

struct Leaving<'w>(&'w mut VecDeque<Vec<u8>>);

impl phy::TxToken for Leaving<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, length: usize, work: F) -> R {
        let mut frame = vec![0; length];
        let result = work(&mut frame);
        self.0.push_back(frame);
        result
    }
}

impl phy::Device for Wire {
    type RxToken<'w> = Arrived;
    type TxToken<'w> = Leaving<'w>;

    fn receive(&mut self, _: Instant) -> Option<(Arrived, Leaving<'_>)> {
        if self.leaving.len() >= FRAMES {
            return None;
        }
        let frame = self.arrived.pop_front()?;
        Some((Arrived(frame), Leaving(&mut self.leaving)))
    }

    fn transmit(&mut self, _: Instant) -> Option<Leaving<'_>> {
        (self.leaving.len() < FRAMES).then_some(Leaving(&mut self.leaving))
    }

    fn capabilities(&self) -> DeviceCapabilities {
        let mut capabilities = DeviceCapabilities::default();
        capabilities.medium = Medium::Ethernet;
        capabilities.max_transmission_unit = MTU;
        capabilities
    }
}

/// A configured host.
struct Stack {
    interface: Interface,
    sockets: SocketSet<'static>,
    connections: [SocketHandle; CONNECTIONS],
}

/// The IP host of a device. A clone has the serial number alone: connections are not copied.
pub(super) struct Host {
    serial: u32,
    wire: Wire,
    stack: Option<Stack>,
}

impl Clone for Host {
    fn clone(&self) -> Self {
        Self::new(self.serial)
    }
}

impl fmt::Debug for Host {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let configured = self.stack.is_some();
        f.debug_struct("Host")
            .field("configured", &configured)
            .finish_non_exhaustive()
    }
}

fn instant(local: u64) -> Instant {
    Instant::from_micros(i64::try_from(local / 1000).unwrap_or(i64::MAX))
}

/// Returns the MAC address of a host that has got none.
fn own_address(serial: u32) -> [u8; 6] {
    let [_, a, b, c] = serial.to_be_bytes();
    [0x02, 0x53, 0x49, a, b, c]
}

/// Returns a long broadcast of a protocol that nothing answers (EtherType for experiments).
pub(super) fn broadcast(serial: u32) -> Vec<u8> {
    let mut frame = vec![0xff; 6];
    frame.extend(own_address(serial));
    frame.extend([0x88, 0xb5]);
    frame.resize(MTU, 0x55);
    frame
}

impl Host {
    pub(super) fn new(serial: u32) -> Self {
        Self {
            serial,
            wire: Wire::default(),
            stack: None,
        }
    }

    /// Starts the host with its parameters; without an address it stays silent.
    pub(super) fn configure(&mut self, parameters: &Parameters, local: u64) {
        self.stack = None;
        let Some(ip) = parameters.ip.filter(|ip| !ip.is_unspecified()) else {
            return;
        };
        let mask = parameters
            .netmask
            .map_or(24, |mask| mask.to_bits().leading_ones());
        let mac = parameters.mac.unwrap_or_else(|| own_address(self.serial));
        if mac[0] & 1 != 0 {
            return;
        }
        let mut config = Config::new(EthernetAddress(mac).into());
        config.random_seed = self.serial.into();
        let mut interface = Interface::new(config, &mut self.wire, instant(local));
        let own = IpCidr::Ipv4(Ipv4Cidr::new(ip, u8::try_from(mask).unwrap_or(24)));
        interface.update_ip_addrs(|addresses| {
            // There is room for two.
            let _ = addresses.push(own);
        });
        if let Some(gateway) = parameters
            .gateway
            .filter(|gateway| !gateway.is_unspecified())
        {
            // There is room for two.
            let _ = interface.routes_mut().add_default_ipv4_route(gateway);
        }
        let mut sockets = SocketSet::new(Vec::new());
        let connections = std::array::from_fn(|_| {
            let buffer = |length| tcp::SocketBuffer::new(vec![0; length]);
            let mut socket = tcp::Socket::new(buffer(REQUEST), buffer(PAGE));
            // A client that has vanished loses its connection.
            socket.set_keep_alive(Some(Duration::from_secs(5)));
            socket.set_timeout(Some(Duration::from_secs(10)));
            sockets.add(socket)
        });
        self.stack = Some(Stack {
            interface,
            sockets,
            connections,
        });
    }

    /// Takes a frame of the MainDevice.
    pub(super) fn receive(&mut self, frame: Vec<u8>) {
        if self.stack.is_some() && self.wire.arrived.len() < FRAMES {
            self.wire.arrived.push_back(frame);
        }
    }

    /// Returns the next frame for the MainDevice.
    pub(super) fn take_frame(&mut self) -> Option<Vec<u8>> {
        self.wire.leaving.pop_front()
    }

    /// Lets the host work; returns the local time of its next work.
    pub(super) fn work(&mut self, local: u64, page: &dyn Fn() -> String) -> u64 {
        let Some(stack) = &mut self.stack else {
            return u64::MAX;
        };
        let now = instant(local);
        stack
            .interface
            .poll(now, &mut self.wire, &mut stack.sockets);
        for handle in stack.connections {
            serve(stack.sockets.get_mut::<tcp::Socket<'_>>(handle), page);
        }
        stack
            .interface
            .poll(now, &mut self.wire, &mut stack.sockets);
        let is_active = |(_, socket): (SocketHandle, &Socket<'_>)| {
            // Another crate may have enabled further kinds of sockets.
            #[allow(irrefutable_let_patterns, reason = "the features of the crate decide")]
            let Socket::Tcp(socket) = socket else {
                return false;
            };
            socket.is_active()
        };
        if !stack.sockets.iter().any(is_active) {
            return u64::MAX;
        }
        let delay = stack.interface.poll_delay(now, &stack.sockets);
        let delay = delay.map_or(LONGEST_NS, |delay| delay.total_micros() * 1000);
        local.saturating_add(delay.clamp(1_000_000, LONGEST_NS))
    }
}

/// Serves one connection.
fn serve(socket: &mut tcp::Socket<'_>, page: &dyn Fn() -> String) {
    // A small server does not wait for late segments of an old connection.
    if socket.state() == tcp::State::TimeWait {
        socket.abort();
    }
    if !socket.is_open() {
        // The port is not 0.
        let _ = socket.listen(HTTP);
        return;
    }
    if !socket.can_recv() {
        if socket.state() == tcp::State::CloseWait {
            socket.close();
        }
        return;
    }
    let mut request = Vec::new();
    let read = socket.peek(REQUEST).map(<[u8]>::to_vec);
    request.extend(read.unwrap_or_default());
    let complete = request.windows(4).any(|end| end == b"\r\n\r\n");
    if !complete && request.len() < REQUEST {
        return;
    }
    let answer = respond(&request, page);
    let _ = socket.recv(|bytes| (bytes.len(), ()));
    let _ = socket.send_slice(answer.as_bytes());
    socket.close();
}

/// Returns the answer to a request.
fn respond(request: &[u8], page: &dyn Fn() -> String) -> String {
    let line = request.split(|byte| *byte == b'\r').next();
    let line = String::from_utf8_lossy(line.unwrap_or_default()).into_owned();
    let mut words = line.split(' ');
    let (status, body) = match (words.next(), words.next()) {
        (Some("GET"), Some("/" | "/index.html")) => ("200 OK", page()),
        (Some("GET"), Some(_)) => ("404 Not Found", "<p>not found</p>\n".to_owned()),
        _ => ("405 Method Not Allowed", String::new()),
    };
    format!(
        "HTTP/1.1 {status}\r\nContent-Type: text/html; charset=utf-8\r\nContent-Length: {}\r\n\
         Connection: close\r\n\r\n{body}",
        body.len()
    )
}
