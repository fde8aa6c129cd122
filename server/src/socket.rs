//! The control socket: JSON lines over a Unix socket.

use std::io::{self, IoSlice};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::fs::{FileTypeExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, sendmsg};
use serde_json::{Map, Value, json};
use tokio::io::Interest;
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{Semaphore, mpsc};

use crate::client::{Answer, Client};
use crate::connection::{Connection, Outgoing, Waiting};
use crate::error::{ErrorCode, OpError};
use crate::hub::Hub;

/// The longest line of a client.
pub const LINE: usize = 64 * 1024;

/// The clients at the same time.
const CLIENTS: usize = 256;

/// Another thread encodes messages with more bytes of memory.
const LARGE: usize = 64 * 1024;

/// The time for the answers to a client that sends no more.
const LAST_ANSWERS: Duration = Duration::from_secs(5);

/// A socket file that is removed in the end.
#[derive(Debug)]
pub struct Socket {
    listener: UnixListener,
    path: PathBuf,
}

impl Socket {
    /// Binds the socket. A file of a server that has died is replaced.
    ///
    /// # Errors
    /// Fails if another server listens there, another file has the name, or the system refuses.
    pub fn bind(path: &Path, mode: u32) -> io::Result<Self> {
        if let Ok(there) = std::fs::symlink_metadata(path) {
            if !there.file_type().is_socket() {
                let message = "another file has this name";
                return Err(io::Error::new(io::ErrorKind::AlreadyExists, message));
            }
            if std::os::unix::net::UnixStream::connect(path).is_ok() {
                let message = "another server listens there";
                return Err(io::Error::new(io::ErrorKind::AddrInUse, message));
            }
            std::fs::remove_file(path)?;
        }
        // No client connects before the mode is set.
        let mask = rustix::process::umask(rustix::fs::Mode::from_raw_mode(0o177));
        let listener = UnixListener::bind(path);
        rustix::process::umask(mask);
        let listener = listener?;
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode))?;
        Ok(Self {
            listener,
            path: path.to_owned(),
        })
    }

    /// Accepts clients until the task ends.
    pub async fn serve(&self, hub: &Arc<Hub>) {
        let places = Arc::new(Semaphore::new(CLIENTS));
        loop {
            match self.listener.accept().await {
                Ok((stream, _)) => {
                    let Ok(place) = Arc::clone(&places).try_acquire_owned() else {
                        let message = format!("{CLIENTS} clients are connected");
                        let error = OpError::new(ErrorCode::Busy, message);
                        let refusal = line(&error.help("close one of them").answer());
                        let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
                        let _ = rustix::net::send(&stream, &refusal, flags);
                        continue;
                    };
                    let hub = Arc::clone(hub);
                    tokio::spawn(async move {
                        serve_client(stream, hub).await;
                        drop(place);
                    });
                }
                Err(error) => {
                    // Too many open files: wait until clients have left.
                    tracing::warn!(%error, "a client was not accepted");
                    tokio::time::sleep(Duration::from_millis(100)).await;
                }
            }
        }
    }
}

impl Drop for Socket {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.path);
    }
}

async fn serve_client(stream: UnixStream, hub: Arc<Hub>) {
    let peer = stream.peer_cred().ok();
    let pid = peer.and_then(|peer| peer.pid());
    let uid = peer.map(|peer| peer.uid());
    let client = Client::new(Arc::clone(&hub), "socket", None, false)
        .with_peer(json!({"pid": pid, "uid": uid}))
        .with_memory();
    let client = Arc::new(client);
    let id = client.id;
    tracing::info!(client = id, ?pid, ?uid, "client connected");
    hub.event(json!({"event": "client", "client": id, "connected": true, "pid": pid, "uid": uid}));
    let stream = Arc::new(stream);
    let (connection, outgoing) = Connection::start(Arc::clone(&client), None);
    let writer = tokio::spawn(write(Arc::clone(&stream), outgoing, Arc::clone(&hub)));
    read(&stream, &connection).await;
    drop(connection);
    client.leave();
    tracing::info!(client = id, "client disconnected");
    hub.event(json!({"event": "client", "client": id, "connected": false}));
    // A client that has sent its last request still reads the answers.
    let _ = tokio::time::timeout(LAST_ANSWERS, writer).await;
}

async fn read(stream: &UnixStream, connection: &Connection) {
    let mut line = Vec::new();
    let mut buffer = vec![0; 8192];
    let mut skips = false;
    loop {
        let count = match stream
            .readable()
            .await
            .and_then(|()| stream.try_read(&mut buffer))
        {
            Ok(0) => return,
            Ok(count) => count,
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => continue,
            Err(_) => return,
        };
        for part in buffer[..count].split_inclusive(|byte| *byte == b'\n') {
            let ends = part.ends_with(b"\n");
            if skips {
                skips = !ends;
                continue;
            }
            line.extend_from_slice(part);
            if line.len() > LINE {
                let error = OpError::new(ErrorCode::TooLarge, "a line is longer than 64 KiB");
                connection.refuse(error).await;
                line.clear();
                skips = !ends;
            } else if ends {
                if !line.trim_ascii().is_empty() {
                    connection.take(&line).await;
                }
                line.clear();
            }
        }
    }
}

async fn write(stream: Arc<UnixStream>, mut outgoing: mpsc::Receiver<Waiting>, hub: Arc<Hub>) {
    while let Some((message, room)) = outgoing.recv().await {
        let sent = match message {
            Outgoing::Answer(Answer {
                body,
                area: Some(area),
                ..
            }) => {
                let memories = [hub.samples.as_fd(), area.as_fd()];
                send_with(&stream, &line(&body), &memories).await
            }
            Outgoing::Answer(Answer { body, .. }) | Outgoing::Object(body) => {
                match room.num_permits() > LARGE {
                    true => send_made(&stream, move || line(&body)).await,
                    false => send(&stream, &line(&body)).await,
                }
            }
            // As text, thousands of numbers.
            Outgoing::Samples(batch) => send_made(&stream, move || line(&batch.object())).await,
        };
        if sent.is_err() {
            return;
        }
    }
}

fn line(body: &Map<String, Value>) -> Vec<u8> {
    let mut line = serde_json::to_vec(body).unwrap_or_default();
    line.push(b'\n');
    line
}

/// Sends a text that is made by another thread: no command waits for it.
async fn send_made(
    stream: &UnixStream,
    make: impl FnOnce() -> Vec<u8> + Send + 'static,
) -> io::Result<()> {
    let text = tokio::task::spawn_blocking(make).await;
    send(stream, &text.map_err(io::Error::other)?).await
}

async fn send(stream: &UnixStream, mut bytes: &[u8]) -> io::Result<()> {
    while !bytes.is_empty() {
        stream.writable().await?;
        match stream.try_write(bytes) {
            Ok(count) => bytes = &bytes[count..],
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

/// Sends bytes, with file descriptors at the first of them (SCM_RIGHTS, unix(7)).
async fn send_with(stream: &UnixStream, bytes: &[u8], fds: &[BorrowedFd<'_>]) -> io::Result<()> {
    let sent = stream
        .async_io(Interest::WRITABLE, || {
            let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(2))];
            let mut control = SendAncillaryBuffer::new(&mut space);
            control.push(SendAncillaryMessage::ScmRights(fds));
            let bytes = [IoSlice::new(bytes)];
            Ok(sendmsg(stream, &bytes, &mut control, SendFlags::NOSIGNAL)?)
        })
        .await?;
    send(stream, &bytes[sent..]).await
}
