//! The sockets: each client has a task and a bounded queue. Too many clients are turned away.

use std::collections::HashMap;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ecaxis_ecat::mailbox::gateway::{FRAME_HEADER, MAX_FRAME, Telegram, frame_length};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::sync::{Semaphore, mpsc};
use tokio::time::{Instant, sleep_until, timeout};

use super::Gateway;
use super::client::{self, Client};

/// The maximum number of TCP connections; further ones get an error as the answer to their first
/// request.
pub(super) const TCP_CLIENTS: usize = 16;
/// The further connections that may wait for that answer, and for how long.
const REFUSALS: usize = 16;
const REFUSAL: Duration = Duration::from_secs(1);
/// The maximum number of UDP clients with a request in progress; requests of further ones are
/// dropped.
const UDP_CLIENTS: usize = 64;
/// The requests of a UDP client that may wait; further ones are dropped.
const UDP_QUEUE: usize = 16;
/// A connection without a request for this time is closed.
const IDLE: Duration = Duration::from_secs(600);
/// A client that does not take its answers for this time loses its connection.
const WRITE: Duration = Duration::from_secs(5);
/// The delay after an error of a socket, such as too many open files.
const RETRY: Duration = Duration::from_millis(100);

/// Answers all clients. Ends only with an error at the start.
pub(super) async fn serve(
    gateway: &Arc<Gateway>,
    tcp: std::net::TcpListener,
    udp: std::net::UdpSocket,
) -> io::Result<()> {
    let (tcp, udp) = (TcpListener::from_std(tcp)?, UdpSocket::from_std(udp)?);
    tokio::join!(serve_tcp(gateway, tcp), serve_udp(gateway, Arc::new(udp)));
    Ok(())
}

async fn serve_tcp(gateway: &Arc<Gateway>, listener: TcpListener) {
    let places = Arc::new(Semaphore::new(TCP_CLIENTS));
    let refusals = Arc::new(Semaphore::new(REFUSALS));
    loop {
        let Ok((stream, address)) = listener.accept().await else {
            tokio::time::sleep(RETRY).await;
            continue;
        };
        let Ok(place) = Arc::clone(&places).try_acquire_owned() else {
            tracing::debug!(%address, "too many clients of the mailbox gateway");
            if let Ok(place) = Arc::clone(&refusals).try_acquire_owned() {
                tokio::spawn(async move {
                    let _ = timeout(REFUSAL, refuse_connection(stream)).await;
                    drop(place);
                });
            }
            continue;
        };
        let client = Client::new(gateway);
        tokio::spawn(async move {
            // A connection that fails ends as one that its client closes.
            let _ = serve_connection(stream, client).await;
            drop(place);
        });
    }
}

/// Answers the first request with an error, and closes the connection.
async fn refuse_connection(mut stream: TcpStream) -> io::Result<()> {
    let mut received = Vec::new();
    let length = loop {
        if let Some(length) = next_frame(&received)? {
            break length;
        }
        if stream.read_buf(&mut received).await? == 0 {
            return Ok(());
        }
    };
    let refusal = client::refusal(received.get(..length).unwrap_or_default());
    stream.write_all(&refusal).await?;
    stream.shutdown().await
}

async fn serve_connection(mut stream: TcpStream, mut client: Client) -> io::Result<()> {
    stream.set_nodelay(true)?;
    let mut received = Vec::new();
    let mut idle = Instant::now() + IDLE;
    loop {
        let Some(length) = next_frame(&received)? else {
            let wake = client
                .next_release()
                .map_or(idle, |release| release.min(idle));
            tokio::select! {
                read = stream.read_buf(&mut received) => {
                    if read? == 0 {
                        return Ok(());
                    }
                }
                () = sleep_until(wake) => client.release(),
            }
            if Instant::now() >= idle {
                return Ok(());
            }
            continue;
        };
        idle = Instant::now() + IDLE;
        let frame: Vec<u8> = received.drain(..length).collect();
        for answer in client.answer(&frame).await {
            timeout(WRITE, stream.write_all(&answer)).await??;
        }
    }
}

/// Returns the length of the first frame once it is complete.
///
/// # Errors
/// Fails if another protocol is spoken: where the next frame begins is not known.
pub(super) fn next_frame(received: &[u8]) -> io::Result<Option<usize>> {
    let Some(header) = received.first_chunk::<FRAME_HEADER>() else {
        return Ok(None);
    };
    let length = frame_length(*header).map_err(io::Error::other)? + FRAME_HEADER;
    Ok((received.len() >= length).then_some(length))
}

async fn serve_udp(gateway: &Arc<Gateway>, socket: Arc<UdpSocket>) {
    let mut clients: HashMap<SocketAddr, mpsc::Sender<Vec<u8>>> = HashMap::new();
    // A longer datagram is cut, and no frame is as long.
    let mut buffer = vec![0; MAX_FRAME + 1];
    loop {
        let Ok((length, address)) = socket.recv_from(&mut buffer).await else {
            tokio::time::sleep(RETRY).await;
            continue;
        };
        let frame = buffer.get(..length).unwrap_or_default();
        if Telegram::parse(frame).is_err() {
            continue;
        }
        let frame = match clients.get(&address) {
            Some(known) => match known.try_send(frame.to_vec()) {
                Err(mpsc::error::TrySendError::Closed(frame)) => frame,
                // With a full queue, the datagram is lost.
                _ => continue,
            },
            None => frame.to_vec(),
        };
        if clients.len() >= UDP_CLIENTS {
            clients.retain(|_, client| !client.is_closed());
        }
        if clients.len() >= UDP_CLIENTS && !clients.contains_key(&address) {
            continue;
        }
        let (sender, frames) = mpsc::channel(UDP_QUEUE);
        // The queue is empty.
        let _ = sender.try_send(frame);
        clients.insert(address, sender);
        let client = Client::new(gateway);
        tokio::spawn(serve_datagrams(
            Arc::clone(&socket),
            address,
            client,
            frames,
        ));
    }
}

/// Answers a UDP client until it has no request and no transfer in progress.
async fn serve_datagrams(
    socket: Arc<UdpSocket>,
    address: SocketAddr,
    mut client: Client,
    mut frames: mpsc::Receiver<Vec<u8>>,
) {
    loop {
        let Some(release) = client.next_release() else {
            // Frames that wait are still received.
            if frames.is_empty() {
                frames.close();
            }
            let Some(frame) = frames.recv().await else {
                return;
            };
            respond(&socket, address, &mut client, &frame).await;
            continue;
        };
        tokio::select! {
            frame = frames.recv() => match frame {
                Some(frame) => respond(&socket, address, &mut client, &frame).await,
                None => sleep_until(release).await,
            },
            () = sleep_until(release) => {}
        }
        client.release();
    }
}

async fn respond(socket: &UdpSocket, address: SocketAddr, client: &mut Client, frame: &[u8]) {
    for answer in client.answer(frame).await {
        // A client that is gone needs no answer.
        let _ = socket.send_to(&answer, address).await;
    }
}
