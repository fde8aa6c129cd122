//! A WebSocket client (RFC 6455).

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use crate::harness::{Server, TOKEN};

pub fn address(server: &Server) -> String {
    let url = server.url.as_ref().unwrap();
    let rest = url.strip_prefix("http://").unwrap();
    rest.split('/').next().unwrap().to_owned()
}

pub fn tcp(server: &Server) -> TcpStream {
    let stream = TcpStream::connect(address(server)).unwrap();
    let timeout = Some(Duration::from_secs(20));
    stream.set_read_timeout(timeout).unwrap();
    stream.set_write_timeout(timeout).unwrap();
    stream
}

/// Reads what has arrived, without waiting: a time-out would last a tick of the kernel at least.
pub fn read_now(stream: &mut TcpStream, buffer: &mut [u8]) -> std::io::Result<usize> {
    stream.set_nonblocking(true)?;
    let read = stream.read(buffer);
    stream.set_nonblocking(false)?;
    read
}

/// Opens a WebSocket that may command (RFC 6455).
pub fn websocket(server: &Server) -> TcpStream {
    let authorization = format!("Authorization: Bearer {TOKEN}\r\n");
    let (stream, head) = upgrade(server, "/api/ws", &authorization);
    assert!(head.starts_with("HTTP/1.1 101"), "{head}");
    stream
}

/// Asks for a WebSocket with further headers. Returns the head of the answer as well.
pub fn upgrade(server: &Server, path: &str, headers: &str) -> (TcpStream, String) {
    let mut stream = tcp(server);
    let host = match headers.contains("Host:") {
        true => String::new(),
        false => format!("Host: {}\r\n", address(server)),
    };
    let request = format!(
        "GET {path} HTTP/1.1\r\n{host}{headers}Connection: Upgrade\r\nUpgrade: websocket\r\n\
         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    );
    stream.write_all(request.as_bytes()).unwrap();
    let mut head = Vec::new();
    while !head.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        stream.read_exact(&mut byte).unwrap();
        head.push(byte[0]);
    }
    (stream, String::from_utf8(head).unwrap())
}

/// A frame of a client with the mask 0 (RFC 6455, 5.2).
pub fn frame(opcode: u8, payload: &[u8]) -> Vec<u8> {
    let mut frame = vec![0x80 | opcode];
    match u16::try_from(payload.len()) {
        Ok(short @ 0..126) => frame.push(0x80 | u8::try_from(short).unwrap()),
        Ok(length) => {
            frame.push(0x80 | 126);
            frame.extend(length.to_be_bytes());
        }
        Err(_) => {
            frame.push(0x80 | 127);
            frame.extend((payload.len() as u64).to_be_bytes());
        }
    }
    frame.extend([0; 4]);
    frame.extend(payload);
    frame
}

/// Reads the next frame: its opcode and payload.
pub fn read_frame(stream: &mut TcpStream) -> (u8, Vec<u8>) {
    let mut head = [0; 2];
    stream.read_exact(&mut head).unwrap();
    let length = match head[1] & 0x7f {
        126 => {
            let mut long = [0; 2];
            stream.read_exact(&mut long).unwrap();
            u64::from(u16::from_be_bytes(long))
        }
        127 => {
            let mut long = [0; 8];
            stream.read_exact(&mut long).unwrap();
            u64::from_be_bytes(long)
        }
        short => u64::from(short),
    };
    let mut payload = vec![0; usize::try_from(length).unwrap()];
    stream.read_exact(&mut payload).unwrap();
    (head[0] & 0x0f, payload)
}
