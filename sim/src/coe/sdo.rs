//! The SDO server (ETG.1000.6 §5.6.2). Requests in, responses out; no mailbox in sight.

use super::{Abort, Dictionary, service};

/// Command, index, subindex, four data bytes.
const INITIATE: usize = 8;
/// CoE header in front of every message.
const COE: usize = 2;

#[derive(Debug, Clone)]
enum Transfer {
    Upload {
        index: u16,
        sub: u8,
        data: Vec<u8>,
        at: usize,
        toggle: bool,
    },
    Download {
        index: u16,
        sub: u8,
        complete: bool,
        data: Vec<u8>,
        size: usize,
        toggle: bool,
    },
}

#[derive(Debug, Clone, Default)]
pub(crate) struct SdoServer {
    transfer: Option<Transfer>,
}

impl SdoServer {
    pub(crate) fn reset(&mut self) {
        self.transfer = None;
    }

    /// Answers one request (what follows the CoE header) with a CoE message of at most `limit`
    /// bytes; an abort by the client has no answer.
    pub(crate) fn request(
        &mut self,
        dictionary: &mut Dictionary<'_>,
        request: &[u8],
        limit: usize,
    ) -> Option<Vec<u8>> {
        let command = *request.first()?;
        let address = match request.get(1..4) {
            Some(&[low, high, sub]) => (u16::from_le_bytes([low, high]), sub),
            _ => (0, 0),
        };
        let result = match command >> 5 {
            0 => self.download_segment(dictionary, command, request.get(1..).unwrap_or_default()),
            1 => self.download(dictionary, command, address, request),
            2 => self.upload(dictionary, command, address, limit),
            3 => self.upload_segment(command, limit),
            4 => {
                self.transfer = None;
                return None;
            }
            _ => Err((Abort::COMMAND, address)),
        };
        Some(result.unwrap_or_else(|(abort, (index, sub))| {
            self.transfer = None;
            let mut out = super::header(service::SDO_REQUEST).to_vec();
            out.push(0x80);
            out.extend_from_slice(&index.to_le_bytes());
            out.push(sub);
            out.extend_from_slice(&abort.0.to_le_bytes());
            out
        }))
    }

    fn upload(
        &mut self,
        dictionary: &Dictionary<'_>,
        command: u8,
        address @ (index, sub): (u16, u8),
        limit: usize,
    ) -> Reply {
        let data = if command & 0x10 != 0 {
            dictionary.read_all(index, sub)
        } else {
            dictionary.read(index, sub)
        }
        .map_err(|abort| (abort, address))?;
        self.transfer = None;
        if (1..=4).contains(&data.len()) {
            let unused = (4 - data.len()) as u8;
            let mut out = initiate(0x43 | unused << 2 | command & 0x10, address);
            out.extend_from_slice(&data);
            out.resize(COE + INITIATE, 0);
            return Ok(out);
        }
        let mut out = initiate(0x41 | command & 0x10, address);
        out.extend_from_slice(&u32::try_from(data.len()).unwrap_or(u32::MAX).to_le_bytes());
        let now = data.len().min(limit.saturating_sub(COE + INITIATE));
        out.extend_from_slice(data.get(..now).unwrap_or_default());
        if now < data.len() {
            self.transfer = Some(Transfer::Upload {
                index,
                sub,
                data,
                at: now,
                toggle: false,
            });
        }
        Ok(out)
    }

    fn upload_segment(&mut self, command: u8, limit: usize) -> Reply {
        let Some(Transfer::Upload {
            index,
            sub,
            data,
            at,
            toggle,
        }) = &mut self.transfer
        else {
            return Err((Abort::COMMAND, (0, 0)));
        };
        if (command & 0x10 != 0) != *toggle {
            return Err((Abort::TOGGLE, (*index, *sub)));
        }
        let rest = data.get(*at..).unwrap_or_default();
        let now = rest.len().min(limit.saturating_sub(COE + 1));
        let last = now == rest.len();
        let unused = 7_usize.saturating_sub(now) as u8;
        let mut out = super::header(service::SDO_RESPONSE).to_vec();
        out.push(command & 0x10 | unused << 1 | u8::from(last));
        out.extend_from_slice(rest.get(..now).unwrap_or_default());
        // A segment is never shorter than the CAN frame it imitates.
        out.resize(out.len().max(COE + INITIATE), 0);
        *at += now;
        *toggle = !*toggle;
        if last {
            self.transfer = None;
        }
        Ok(out)
    }

    fn download(
        &mut self,
        dictionary: &mut Dictionary<'_>,
        command: u8,
        address @ (index, sub): (u16, u8),
        request: &[u8],
    ) -> Reply {
        let fail = |abort| (abort, address);
        self.transfer = None;
        let complete = command & 0x10 != 0;
        let capacity = dictionary.capacity(index, sub, complete).map_err(fail)?;
        let value = request.get(4..INITIATE).ok_or(fail(Abort::LENGTH))?;
        if command & 0x02 != 0 {
            let len = if command & 0x01 != 0 {
                4 - usize::from(command >> 2 & 3)
            } else {
                capacity.min(4)
            };
            let data = value.get(..len).unwrap_or_default();
            commit(dictionary, address, complete, data).map_err(fail)?;
        } else {
            let size = <[u8; 4]>::try_from(value).map_or(0, u32::from_le_bytes);
            let size = usize::try_from(size).unwrap_or(usize::MAX);
            if size > capacity {
                return Err(fail(Abort::TOO_LONG));
            }
            let rest = request.get(INITIATE..).unwrap_or_default();
            if rest.len() >= size {
                let data = rest.get(..size).unwrap_or_default();
                commit(dictionary, address, complete, data).map_err(fail)?;
            } else {
                let mut data = Vec::with_capacity(size);
                data.extend_from_slice(rest);
                self.transfer = Some(Transfer::Download {
                    index,
                    sub,
                    complete,
                    data,
                    size,
                    toggle: false,
                });
            }
        }
        let mut out = initiate(0x60 | command & 0x10, address);
        out.resize(COE + INITIATE, 0);
        Ok(out)
    }

    fn download_segment(
        &mut self,
        dictionary: &mut Dictionary<'_>,
        command: u8,
        payload: &[u8],
    ) -> Reply {
        let Some(Transfer::Download {
            index,
            sub,
            complete,
            data,
            size,
            toggle,
        }) = &mut self.transfer
        else {
            return Err((Abort::COMMAND, (0, 0)));
        };
        let (address, complete) = ((*index, *sub), *complete);
        if (command & 0x10 != 0) != *toggle {
            return Err((Abort::TOGGLE, address));
        }
        let unused = if payload.len() <= 7 {
            usize::from(command >> 1 & 7)
        } else {
            0
        };
        let used = payload.len().saturating_sub(unused);
        if data.len() + used > *size {
            return Err((Abort::TOO_LONG, address));
        }
        data.extend_from_slice(payload.get(..used).unwrap_or_default());
        *toggle = !*toggle;
        if command & 0x01 != 0 {
            let (data, size) = (std::mem::take(data), *size);
            self.transfer = None;
            if data.len() < size {
                return Err((Abort::TOO_SHORT, address));
            }
            commit(dictionary, address, complete, &data).map_err(|abort| (abort, address))?;
        }
        let mut out = super::header(service::SDO_RESPONSE).to_vec();
        out.push(0x20 | command & 0x10);
        out.resize(COE + INITIATE, 0);
        Ok(out)
    }
}

type Reply = Result<Vec<u8>, (Abort, (u16, u8))>;

fn initiate(command: u8, (index, sub): (u16, u8)) -> Vec<u8> {
    let mut out = super::header(service::SDO_RESPONSE).to_vec();
    out.push(command);
    out.extend_from_slice(&index.to_le_bytes());
    out.push(sub);
    out
}

fn commit(
    dictionary: &mut Dictionary<'_>,
    (index, sub): (u16, u8),
    complete: bool,
    data: &[u8],
) -> Result<(), Abort> {
    if complete {
        dictionary.write_all(index, sub, data)
    } else {
        dictionary.write(index, sub, data)
    }
}
