//! A small SDO and file server that shares no code with the clients, and what its tests need.

use std::pin::pin;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use ecaxis_master::mailbox::{CoeClient, MailboxLayout, Timeouts};

pub mod describe;
pub mod fault_injection;
pub mod files;
pub mod server;

pub const STATION: u16 = 0x1001;

pub fn layout(len: u16) -> MailboxLayout {
    MailboxLayout {
        station: STATION,
        out_address: 0x1000,
        out_len: len,
        in_address: 0x1400,
        in_len: len,
        out_sm: 0,
        in_sm: 1,
    }
}

pub fn client() -> CoeClient {
    CoeClient::new(layout(48)).with_timeouts(Timeouts {
        request: Duration::from_millis(100),
        answer: Duration::from_millis(500),
        transfer: Duration::from_secs(10),
    })
}

/// The tests wait only for virtual time, so a future is ready at once.
pub fn block_on<T>(future: impl Future<Output = T>) -> T {
    let mut future = pin!(future);
    match future
        .as_mut()
        .poll(&mut Context::from_waker(Waker::noop()))
    {
        Poll::Ready(value) => value,
        Poll::Pending => panic!("a future that waits for nothing was not ready"),
    }
}
