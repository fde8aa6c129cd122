//! A computer at the switch: it pings hosts and opens their pages, in the time of the run.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use ecaxis_master::eoe::EthernetInterface;
use smoltcp::iface::{Config, Interface, SocketHandle, SocketSet};
use smoltcp::phy::{self, ChecksumCapabilities, DeviceCapabilities, Medium};
use smoltcp::socket::{icmp, tcp};
use smoltcp::time::{Duration, Instant};
use smoltcp::wire::{
    EthernetAddress, Icmpv4Packet, Icmpv4Repr, IpAddress, IpCidr, Ipv4Address, Ipv4Cidr,
};

const PERIOD_NS: u64 = 20_000_000;
const PING: u16 = 0x22;

/// What the client has seen.
#[derive(Debug, Default, Clone)]
pub struct Seen {
    pub pings: u32,
    /// The time of each echo in ns.
    pub echoes: Vec<u64>,
    /// The time of each ping, and the round-trip time of each echo in ns.
    sent: Vec<u64>,
    pub round_trips: Vec<u64>,
    /// Pages with the time of their end in ns.
    pub pages: Vec<(u64, String)>,
}

#[derive(Default)]
struct Wire {
    arrived: VecDeque<Vec<u8>>,
    leaving: VecDeque<Vec<u8>>,
}

struct Arrived(Vec<u8>);
struct Leaving<'w>(&'w mut VecDeque<Vec<u8>>);

impl phy::RxToken for Arrived {
    fn consume<R, F: FnOnce(&[u8]) -> R>(self, work: F) -> R {
        work(&self.0)
    }
}

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
        Some((
            Arrived(self.arrived.pop_front()?),
            Leaving(&mut self.leaving),
        ))
    }

    fn transmit(&mut self, _: Instant) -> Option<Leaving<'_>> {
        Some(Leaving(&mut self.leaving))
    }

    fn capabilities(&self) -> DeviceCapabilities {
        let mut capabilities = DeviceCapabilities::default();
        capabilities.medium = Medium::Ethernet;
        capabilities.max_transmission_unit = 1514;
        capabilities
    }
}

/// Asks its host again and again, a ping and a page in turn.
pub struct Client {
    wire: Wire,
    interface: Interface,
    sockets: SocketSet<'static>,
    ping: SocketHandle,
    page: SocketHandle,
    host: Ipv4Address,
    next: u64,
    received: Vec<u8>,
    requested: bool,
    port: u16,
    seen: Arc<Mutex<Seen>>,
}

impl std::fmt::Debug for Client {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Client")
    }
}

impl Client {
    pub fn new(host: [u8; 4]) -> (Self, Arc<Mutex<Seen>>) {
        let mut wire = Wire::default();
        let mut config = Config::new(EthernetAddress([0x02, 0, 0, 0, 0, 0x99]).into());
        config.random_seed = 7;
        let mut interface = Interface::new(config, &mut wire, Instant::ZERO);
        let own = Ipv4Cidr::new(Ipv4Address::new(192, 168, 7, 1), 24);
        interface.update_ip_addrs(|all| all.push(IpCidr::Ipv4(own)).unwrap());
        let mut sockets = SocketSet::new(Vec::new());
        let packets =
            || icmp::PacketBuffer::new(vec![icmp::PacketMetadata::EMPTY; 8], vec![0; 1024]);
        let mut ping = icmp::Socket::new(packets(), packets());
        ping.bind(icmp::Endpoint::Ident(PING)).unwrap();
        let buffer = || tcp::SocketBuffer::new(vec![0; 4096]);
        let ping = sockets.add(ping);
        let page = sockets.add(tcp::Socket::new(buffer(), buffer()));
        let seen = Arc::<Mutex<Seen>>::default();
        let client = Self {
            wire,
            interface,
            sockets,
            ping,
            page,
            host: Ipv4Address::from(host),
            next: 0,
            received: Vec::new(),
            requested: false,
            port: 50_000,
            seen: Arc::clone(&seen),
        };
        (client, seen)
    }

    fn work(&mut self, now: u64) {
        let time = Instant::from_micros(i64::try_from(now / 1000).unwrap());
        self.interface.poll(time, &mut self.wire, &mut self.sockets);
        let mut seen = self.seen.lock().unwrap();
        let host = IpAddress::Ipv4(self.host);
        let ping = self.sockets.get_mut::<icmp::Socket<'_>>(self.ping);
        while let Ok((packet, from)) = ping.recv() {
            assert_eq!(from, host);
            let number = Icmpv4Packet::new_checked(packet).unwrap().echo_seq_no();
            let sent = seen.sent[usize::from(number)];
            seen.round_trips.push(now - sent);
            seen.echoes.push(now);
        }
        if now >= self.next && ping.can_send() {
            self.next = now + PERIOD_NS;
            let echo = Icmpv4Repr::EchoRequest {
                ident: PING,
                seq_no: u16::try_from(seen.pings % 0x1_0000).unwrap(),
                data: &[0xa5; 300],
            };
            // The buffer is full while no one answers ARP.
            if let Ok(room) = ping.send(echo.buffer_len(), host) {
                let mut packet = Icmpv4Packet::new_unchecked(room);
                echo.emit(&mut packet, &ChecksumCapabilities::default());
                seen.pings += 1;
                seen.sent.push(now);
            }
        }
        let page = self.sockets.get_mut::<tcp::Socket<'_>>(self.page);
        if !page.is_open() {
            if let Ok(text) = String::from_utf8(std::mem::take(&mut self.received))
                && text.contains("</html>")
            {
                seen.pages.push((now, text));
            }
            self.port = 50_000 + (self.port + 1 - 50_000) % 10_000;
            self.requested = false;
            page.set_timeout(Some(Duration::from_millis(1000)));
            let context = self.interface.context();
            page.connect(context, (host, 80), self.port).unwrap();
        } else if page.can_send() && !self.requested {
            self.requested = true;
            page.send_slice(b"GET / HTTP/1.1\r\nHost: drive\r\n\r\n")
                .unwrap();
        }
        if page.can_recv() {
            let received = &mut self.received;
            page.recv(|bytes| {
                received.extend_from_slice(bytes);
                (bytes.len(), ())
            })
            .unwrap();
        } else if self.requested && !page.may_recv() {
            page.close();
            // The test does not wait for the time-wait of each connection.
            if !page.may_send() && page.send_queue() == 0 {
                page.abort();
            }
        }
        drop(seen);
        self.interface.poll(time, &mut self.wire, &mut self.sockets);
    }
}

impl EthernetInterface for Client {
    fn receive(&mut self, now: u64, buffer: &mut [u8]) -> Option<usize> {
        if self.wire.leaving.is_empty() {
            self.work(now);
        }
        let frame = self.wire.leaving.pop_front()?;
        buffer[..frame.len()].copy_from_slice(&frame);
        Some(frame.len())
    }

    fn send(&mut self, now: u64, frame: &[u8]) -> bool {
        self.wire.arrived.push_back(frame.to_vec());
        self.work(now);
        true
    }
}
