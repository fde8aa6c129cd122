//! Large answers: few at once, at a low priority, in pieces. A stop never waits for them.

use std::fmt;
use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use axum::body::{Body, Bytes};
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::time::timeout;

use crate::error::{ErrorCode, OpError};

/// The answers that are made at the same time.
const MAKING: usize = 2;
/// The answers that are held in memory, made or to be made.
const HELD: usize = 16;
/// The exports at the same time. Each waits for its client.
const EXPORTS: usize = 2;
/// The bytes of a piece of an export, and the pieces that may wait for the client.
const PIECE: usize = 256 * 1024;
const PIECES: usize = 2;
/// The time for a client to take a piece, and the whole export.
const STALL: Duration = Duration::from_secs(10);
const WHOLE: Duration = Duration::from_secs(300);
/// The nice value of the threads that make large answers.
const NICE: i32 = 10;

/// The places for large answers.
#[derive(Debug)]
pub struct Bulk {
    making: Arc<Semaphore>,
    held: Arc<Semaphore>,
    exports: Arc<Semaphore>,
}

impl Default for Bulk {
    fn default() -> Self {
        Self {
            making: Arc::new(Semaphore::new(MAKING)),
            held: Arc::new(Semaphore::new(HELD)),
            exports: Arc::new(Semaphore::new(EXPORTS)),
        }
    }
}

/// Bytes that keep their place until they are sent.
struct Held {
    bytes: Vec<u8>,
    _place: OwnedSemaphorePermit,
}

impl AsRef<[u8]> for Held {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

fn place(of: &Arc<Semaphore>) -> Result<OwnedSemaphorePermit, OpError> {
    Arc::clone(of).try_acquire_owned().map_err(|_| {
        OpError::new(ErrorCode::Busy, "too many large answers wait")
            .help("wait for the answers of earlier requests")
    })
}

impl Bulk {
    /// Returns the bytes that `make` makes.
    ///
    /// # Errors
    /// Fails if too many answers are held.
    pub async fn bytes(
        &self,
        make: impl FnOnce() -> Vec<u8> + Send + 'static,
    ) -> Result<Bytes, OpError> {
        let failed = |error: &dyn fmt::Display| OpError::new(ErrorCode::Failed, error.to_string());
        let place = place(&self.held)?;
        let making = Arc::clone(&self.making).acquire_owned().await;
        let making = making.map_err(|error| failed(&error))?;
        let made = tokio::task::spawn_blocking(move || {
            lower_priority();
            let bytes = make();
            drop(making);
            Bytes::from_owner(Held {
                bytes,
                _place: place,
            })
        });
        made.await.map_err(|error| failed(&error))
    }

    /// Returns a body that `make` writes while the client takes it. A body that is not whole ends with
    /// an error.
    ///
    /// # Errors
    /// Fails if too many exports are made.
    pub async fn body(
        &self,
        make: impl FnOnce(Pieces) -> io::Result<Pieces> + Send + 'static,
    ) -> Result<Body, OpError> {
        let place = place(&self.exports)?;
        let (pieces, mut receiver) = mpsc::channel(PIECES);
        let whole = Arc::new(AtomicBool::new(false));
        let done = Arc::clone(&whole);
        tokio::task::spawn_blocking(move || {
            lower_priority();
            let made = make(Pieces::new(pieces)).and_then(|mut out| {
                out.flush()?;
                // The mark comes before the sender is dropped.
                done.store(true, Ordering::Release);
                Ok(())
            });
            if let Err(error) = made {
                tracing::debug!(%error, "an export was not taken");
            }
            drop(place);
        });
        let mut cut = false;
        let next = move |context: &mut Context<'_>| match receiver.poll_recv(context) {
            Poll::Ready(None) if !whole.load(Ordering::Acquire) && !cut => {
                cut = true;
                let error: io::Error = io::ErrorKind::UnexpectedEof.into();
                Poll::Ready(Some(Err(error)))
            }
            Poll::Ready(piece) => Poll::Ready(piece.map(Ok)),
            Poll::Pending => Poll::Pending,
        };
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
    to: mpsc::Sender<Bytes>,
    piece: Vec<u8>,
    began: Instant,
    runtime: Handle,
}

impl Pieces {
    fn new(to: mpsc::Sender<Bytes>) -> Self {
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
        let sent = self.runtime.block_on(timeout(left, self.to.send(piece)));
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
    fn a_body_that_ends_is_whole_each_time() {
        runtime().block_on(async {
            let bulk = Bulk::default();
            for _ in 0..2000 {
                while bulk.exports.available_permits() == 0 {
                    tokio::task::yield_now().await;
                }
                let body = bulk.body(|mut out| {
                    out.write_all(b"all")?;
                    Ok(out)
                });
                let body = body.await.expect("a place");
                axum::body::to_bytes(body, 10).await.expect("whole");
            }
        });
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
    fn a_body_that_is_not_whole_ends_with_an_error() {
        runtime().block_on(async {
            let bulk = Bulk::default();
            let body = bulk.body(|mut out| {
                out.write_all(&[0; 4096])?;
                Err(io::ErrorKind::TimedOut.into())
            });
            let body = body.await.expect("a place");
            let cut = axum::body::to_bytes(body, usize::MAX).await;
            cut.expect_err("not whole");
        });
    }

    #[test]
    fn more_than_the_places_is_refused_and_what_ends_gives_its_place_back() {
        runtime().block_on(async {
            let bulk = Bulk::default();
            let endless = |mut out: Pieces| loop {
                out.write_all(&[0; 4096])?;
            };
            let exports = [
                bulk.body(endless).await.expect("a place"),
                bulk.body(endless).await.expect("a place"),
            ];
            let refused = bulk.body(endless).await.expect_err("no place");
            assert_eq!(refused.code, ErrorCode::Busy);
            // Other answers do not wait for exports.
            let mut held = Vec::new();
            for _ in 0..HELD {
                held.push(bulk.bytes(|| vec![0; 10]).await.expect("a place"));
            }
            bulk.bytes(Vec::new).await.expect_err("no place");
            drop((exports, held));
            bulk.bytes(Vec::new).await.expect("a place again");
            while bulk.exports.available_permits() < EXPORTS {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        });
    }
}
