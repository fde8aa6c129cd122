//! Who may connect over HTTP: how many connections, of which address, for how long.
//!
//! Without these limits, a client that sends half a request a thousand times leaves no file
//! descriptor for a stop or for the bus.

use std::collections::HashMap;
use std::io::{self, IoSlice};
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use rustix::net::SendFlags;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{Sleep, sleep};

use crate::socket::LINE;

/// The connections at the same time.
pub const CONNECTIONS: usize = 256;
/// Those of this computer: others find a place as well.
pub const OF_LOOPBACK: usize = 192;
/// Those of one address of another computer; of IPv6, of one network.
pub const OF_ADDRESS: usize = 64;
/// The time for the head of a request, also of the next one of a connection.
const HEAD: Duration = Duration::from_secs(15);
/// A client that takes nothing for this time is disconnected.
const STALL: Duration = Duration::from_secs(20);
/// The pause after an error of the system, such as too many open files.
const PAUSE: Duration = Duration::from_millis(100);

const REFUSAL: &[u8] = b"HTTP/1.1 503 Service Unavailable\r\nRetry-After: 5\r\n\
    Connection: close\r\nContent-Length: 21\r\n\r\ntoo many connections\n";

/// The connections that are open.
#[derive(Debug, Default)]
struct Admission {
    open: Mutex<Open>,
}

#[derive(Debug, Default)]
struct Open {
    total: usize,
    of_address: HashMap<IpAddr, usize>,
}

impl Admission {
    fn lock(&self) -> MutexGuard<'_, Open> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns a place for a connection; `None` if there is none.
    fn admit(self: &Arc<Self>, address: IpAddr) -> Option<Place> {
        let address = match address.to_canonical() {
            // A computer has as many addresses of its network as it likes.
            IpAddr::V6(v6) if !v6.is_loopback() => {
                let [a, b, c, d, ..] = v6.segments();
                IpAddr::from([a, b, c, d, 0, 0, 0, 0])
            }
            address => address,
        };
        let mut open = self.lock();
        let own = open.of_address.get(&address).copied().unwrap_or_default();
        let most = match address.is_loopback() {
            true => OF_LOOPBACK,
            false => OF_ADDRESS,
        };
        if open.total >= CONNECTIONS || own >= most {
            return None;
        }
        open.total += 1;
        open.of_address.insert(address, own + 1);
        Some(Place {
            admission: Arc::clone(self),
            address,
        })
    }
}

/// The place of a connection, which is free once this is dropped.
#[derive(Debug)]
struct Place {
    admission: Arc<Admission>,
    address: IpAddr,
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut open = self.admission.lock();
        open.total -= 1;
        if let Some(own) = open.of_address.get_mut(&self.address) {
            *own -= 1;
            if *own == 0 {
                open.of_address.remove(&self.address);
            }
        }
    }
}

/// Accepts clients until the task ends.
pub(crate) async fn serve(listener: TcpListener, router: Router) {
    let admission = Arc::<Admission>::default();
    loop {
        let (stream, peer) = match listener.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                tracing::warn!(%error, "a client was not accepted");
                sleep(PAUSE).await;
                continue;
            }
        };
        let Some(place) = admission.admit(peer.ip()) else {
            tracing::debug!(%peer, "too many connections");
            // As far as it goes at once: the client may not read.
            let _ = rustix::net::send(&stream, REFUSAL, SendFlags::DONTWAIT | SendFlags::NOSIGNAL);
            continue;
        };
        let _ = stream.set_nodelay(true);
        let service = TowerToHyperService::new(router.clone());
        let io = TokioIo::new(Paced {
            stream,
            stalled: None,
            _place: place,
        });
        tokio::spawn(async move {
            let mut http = http1::Builder::new();
            http.timer(TokioTimer::new())
                .header_read_timeout(HEAD)
                .max_buf_size(LINE);
            if let Err(error) = http.serve_connection(io, service).with_upgrades().await {
                tracing::debug!(%error, %peer, "the connection has ended");
            }
        });
    }
}

/// A connection that fails if its client takes nothing for [`STALL`].
#[derive(Debug)]
struct Paced {
    stream: TcpStream,
    stalled: Option<Pin<Box<Sleep>>>,
    /// Of a WebSocket as well: it keeps the connection.
    _place: Place,
}

impl Paced {
    fn pace<T>(
        &mut self,
        context: &mut Context<'_>,
        poll: Poll<io::Result<T>>,
    ) -> Poll<io::Result<T>> {
        if poll.is_ready() {
            self.stalled = None;
            return poll;
        }
        let stalled = self.stalled.get_or_insert_with(|| Box::pin(sleep(STALL)));
        ready!(stalled.as_mut().poll(context));
        Poll::Ready(Err(io::ErrorKind::TimedOut.into()))
    }
}

impl AsyncRead for Paced {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for Paced {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let poll = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.pace(context, poll)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let poll = Pin::new(&mut self.stream).poll_write_vectored(context, parts);
        self.pace(context, poll)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_limited_in_total_and_for_an_address() {
        let admission = Arc::<Admission>::default();
        let [far, other] = ["10.0.0.2", "10.0.0.3"].map(|text| text.parse::<IpAddr>().unwrap());
        let mut places: Vec<Place> = (0..OF_ADDRESS)
            .map(|_| admission.admit(far).expect("a place"))
            .collect();
        assert!(admission.admit(far).is_none());
        let mapped: IpAddr = "::ffff:10.0.0.2".parse().unwrap();
        assert!(admission.admit(mapped).is_none(), "the same address");
        places.push(admission.admit(other).expect("of another address"));
        let near = IpAddr::from([127, 0, 0, 1]);
        while let Some(place) = admission.admit(near) {
            places.push(place);
        }
        assert_eq!(places.len(), OF_ADDRESS + 1 + OF_LOOPBACK - 1);
        assert_eq!(places.len(), CONNECTIONS);
        assert!(admission.admit(other).is_none());
        drop(places);
        assert_eq!(admission.lock().total, 0);
        assert!(admission.lock().of_address.is_empty());
    }
}
