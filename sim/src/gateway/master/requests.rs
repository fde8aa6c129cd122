//! SDO transfers with nodes, one at a time: those of their boot, and those of a configuration tool.

use super::super::can::CanFrame;
use super::super::sdo::{Client, Progress};
use super::super::{Abort, Gateway, MS};
use super::{Purpose, Request, SdoResult};

/// The response time-out of an SDO server, in ns.
const SDO_NS: u64 = 500 * MS;

impl Gateway {
    /// Reads or writes an object of a node over the secondary network, as a configuration tool does
    /// through the master. [`Gateway::take_sdo_result`] returns the result.
    pub fn request_sdo(&mut self, node: u8, index: u16, sub: u8, data: Option<Vec<u8>>) {
        self.enqueue(node, index, sub, data, Purpose::Tool, self.now);
    }

    pub(super) fn enqueue(
        &mut self,
        node: u8,
        index: u16,
        sub: u8,
        data: Option<Vec<u8>>,
        purpose: Purpose,
        now: u64,
    ) {
        self.master.queue.push_back(Request {
            node,
            index,
            sub,
            data,
            purpose,
        });
        self.next_sdo(now);
    }

    fn next_sdo(&mut self, now: u64) {
        if self.master.active.is_some() {
            return;
        }
        let Some(mut request) = self.master.queue.pop_front() else {
            return;
        };
        let data = request.data.take();
        let (client, first) = Client::start(request.index, request.sub, data);
        let node = request.node;
        self.master.active = Some((request, client, now + SDO_NS));
        self.send_sdo(node, &first, now);
    }

    pub(super) fn send_sdo(&mut self, node: u8, message: &[u8; 8], now: u64) {
        let frame = CanFrame::new(0x600 + u16::from(node & 0x7f), message);
        self.bus.send(self.options.node_id, frame, now);
    }

    /// Handles a frame of a node's SDO server.
    pub(in super::super) fn sdo_response(&mut self, node: u8, frame: &CanFrame, now: u64) {
        let awaited = |(request, ..): &(Request, Client, u64)| request.node == node;
        if frame.data().len() != 8 || !self.master.active.as_ref().is_some_and(awaited) {
            return;
        }
        let Some((request, mut client, _)) = self.master.active.take() else {
            return;
        };
        match client.response(&frame.padded()) {
            Progress::Send(message) => {
                self.master.active = Some((request, client, now + SDO_NS));
                self.send_sdo(node, &message, now);
            }
            Progress::Done(result) => self.finish(&request, result, now),
        }
    }

    pub(super) fn finish(&mut self, request: &Request, result: Result<Vec<u8>, Abort>, now: u64) {
        match request.purpose {
            Purpose::Boot => self.boot_answer(request, result, now),
            Purpose::Tool => self.master.results.push_back(SdoResult {
                node: request.node,
                index: request.index,
                sub: request.sub,
                data: result,
            }),
        }
        self.next_sdo(now);
    }
}
