//! Large answers: few at once, at a low priority, in pieces. A stop never waits for them.

use std::io::{self, Write};
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::{Body, Bytes};
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::time::timeout;

use crate::error::{ErrorCode, OpError};

/// The answers that are made at the same time.
const RUNNING: usize = 2;
/// Those that may wait for their turn.
const WAITING: usize = 8;
/// The bytes of a piece, and the pieces that may wait for the client.
const PIECE: usize = 256 * 1024;
const PIECES: usize = 2;
/// The time for a client to take a piece, and the whole answer.
const STALL: Duration = Duration::from_secs(10);
const WHOLE: Duration = Duration::from_secs(300);
/// The nice value of the threads that make large answers.
const NICE: i32 = 10;

/// The places for large answers.
#[derive(Debug)]
pub struct Bulk {
    running: Arc<Semaphore>,
    /// Running and waiting.
    places: Arc<Semaphore>,
}

/// A place for one large answer.
#[derive(Debug)]
struct Place {
    _running: OwnedSemaphorePermit,
    _place: OwnedSemaphorePermit,
}

impl Default for Bulk {
    fn default() -> Self {
        Self {
            running: Arc::new(Semaphore::new(RUNNING)),
            places: Arc::new(Semaphore::new(RUNNING + WAITING)),
        }
    }
}

impl Bulk {
    async fn place(&self) -> Result<Place, OpError> {
        let full = || {
            OpError::new(ErrorCode::Busy, "too many large answers wait")
                .help("wait for the answers of earlier requests")
        };
        let place = Arc::clone(&self.places).try_acquire_owned();
        let place = place.map_err(|_| full())?;
        let running = Arc::clone(&self.running).acquire_owned().await;
        Ok(Place {
            _running: running.map_err(|_| full())?,
            _place: place,
        })
    }

    /// Does work that takes long.
    ///
    /// # Errors
    /// Fails if too much of it waits.
    pub async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, OpError> {
        let place = self.place().await?;
        let done = tokio::task::spawn_blocking(move || {
            lower_priority();
            let result = work();
            drop(place);
            result
        });
        done.await
            .map_err(|error| OpError::new(ErrorCode::Failed, error.to_string()))
    }

    /// Returns a body that `make` writes while the client takes it.
    ///
    /// # Errors
    /// Fails if too many large answers wait.
    pub async fn body(
        &self,
        make: impl FnOnce(Pieces) -> io::Result<Pieces> + Send + 'static,
    ) -> Result<Body, OpError> {
        let place = self.place().await?;
        let (pieces, mut receiver) = mpsc::channel(PIECES);
        tokio::task::spawn_blocking(move || {
            lower_priority();
            let cut = pieces.clone();
            let made = make(Pieces::new(pieces)).and_then(|mut out| out.flush());
            if let Err(error) = made {
                tracing::debug!(%error, "a large answer was not taken");
                // The client sees that the body is not whole.
                let _ = cut.try_send(Err(error));
            }
            drop(place);
        });
        let next = move |context: &mut std::task::Context<'_>| receiver.poll_recv(context);
        Ok(Body::from_stream(futures_util::stream::poll_fn(next)))
    }
}

/// For the calling thread; without the right, nothing changes.
fn lower_priority() {
    let _ = rustix::process::setpriority_process(None, NICE);
}

/// Takes the bytes of a large answer.
#[derive(Debug)]
pub struct Pieces {
    to: mpsc::Sender<io::Result<Bytes>>,
    piece: Vec<u8>,
    began: Instant,
    runtime: Handle,
}

impl Pieces {
    fn new(to: mpsc::Sender<io::Result<Bytes>>) -> Self {
        Self {
            to,
            piece: Vec::new(),
            began: Instant::now(),
            runtime: Handle::current(),
        }
    }
}

impl Write for Pieces {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.piece.extend_from_slice(bytes);
        if self.piece.len() >= PIECE {
            self.flush()?;
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        if self.piece.is_empty() {
            return Ok(());
        }
        let left = WHOLE.saturating_sub(self.began.elapsed()).min(STALL);
        let piece = Bytes::from(std::mem::take(&mut self.piece));
        let sent = self
            .runtime
            .block_on(timeout(left, self.to.send(Ok(piece))));
        match sent {
            Ok(Ok(())) => Ok(()),
            Ok(Err(_)) => Err(io::ErrorKind::BrokenPipe.into()),
            Err(_) => Err(io::ErrorKind::TimedOut.into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn runtime() -> tokio::runtime::Runtime {
        tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .expect("a runtime")
    }

    #[test]
    fn a_body_is_made_in_pieces_while_it_is_taken() {
        runtime().block_on(async {
            let bulk = Bulk::default();
            let body = bulk
                .body(|mut out| {
                    (0..1000_u32).try_for_each(|n| out.write_all(&[n as u8; 4096]))?;
                    Ok(out)
                })
                .await
                .expect("a place");
            let bytes = axum::body::to_bytes(body, usize::MAX).await.expect("whole");
            assert_eq!(bytes.len(), 4_096_000);
            assert_eq!(bytes[4096 * 999], 999_u32 as u8);
        });
    }

    #[test]
    fn more_than_the_places_is_refused_and_a_dropped_body_gives_its_place_back() {
        runtime().block_on(async {
            let bulk = Bulk::default();
            let endless = |mut out: Pieces| loop {
                out.write_all(&[0; 4096])?;
            };
            let first = bulk.body(endless).await.expect("a place");
            let second = bulk.body(endless).await.expect("a place");
            let waiting: Vec<_> = (0..WAITING).map(|_| bulk.places.try_acquire()).collect();
            assert!(waiting.iter().all(Result::is_ok));
            let refused = bulk.run(|| ()).await.expect_err("no place");
            assert_eq!(refused.code, ErrorCode::Busy);
            drop((first, second, waiting));
            bulk.run(|| ()).await.expect("a place again");
        });
    }
}
