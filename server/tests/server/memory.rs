//! The shared memory of a client that knows docs/server.md only.

use std::io::IoSliceMut;
use std::mem::MaybeUninit;
use std::os::fd::OwnedFd;

use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};
use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, recvmsg};
use serde_json::{Value, json};

use crate::harness::Client;

/// Words that another process shares.
pub struct Words {
    base: *mut u64,
    count: usize,
}

impl Words {
    fn map(fd: &OwnedFd, protection: ProtFlags) -> Self {
        let bytes = usize::try_from(rustix::fs::fstat(fd).unwrap().st_size).unwrap();
        // SAFETY: a new mapping at an address that the kernel chooses.
        let base = unsafe {
            mmap(
                std::ptr::null_mut(),
                bytes,
                protection,
                MapFlags::SHARED,
                fd,
                0,
            )
            .unwrap()
        };
        Self {
            base: base.cast(),
            count: bytes / 8,
        }
    }

    pub fn get(&self, at: usize) -> u64 {
        assert!(at < self.count);
        // SAFETY: inside the mapping.
        unsafe { self.base.add(at).read_volatile() }
    }

    pub fn set(&self, at: usize, value: u64) {
        assert!(at < self.count);
        // SAFETY: inside the mapping, which is writable.
        unsafe { self.base.add(at).write_volatile(value) }
        std::sync::atomic::fence(std::sync::atomic::Ordering::SeqCst);
    }
}

impl Drop for Words {
    fn drop(&mut self) {
        // SAFETY: the mapping of this value.
        unsafe { munmap(self.base.cast(), self.count * 8).unwrap() };
    }
}

pub struct Area {
    pub samples: Words,
    pub commands: Words,
}

/// Asks for the area, and takes its file descriptors.
pub fn attach(client: &mut Client) -> Area {
    client.send("area", json!({}));
    let mut bytes = [0; 4096];
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(2))];
    let mut control = RecvAncillaryBuffer::new(&mut space);
    let mut buffers = [IoSliceMut::new(&mut bytes)];
    let got = recvmsg(
        &client.stream,
        &mut buffers,
        &mut control,
        RecvFlags::empty(),
    )
    .unwrap();
    let fds: Vec<OwnedFd> = control
        .drain()
        .filter_map(|message| match message {
            RecvAncillaryMessage::ScmRights(fds) => Some(fds),
            _ => None,
        })
        .flatten()
        .collect();
    let answer: Value = serde_json::from_slice(&bytes[..got.bytes]).unwrap();
    assert_eq!(answer["ok"], json!(true), "{answer}");
    let [samples, commands] = fds.try_into().expect("two file descriptors");
    Area {
        samples: Words::map(&samples, ProtFlags::READ),
        commands: Words::map(&commands, ProtFlags::READ | ProtFlags::WRITE),
    }
}

impl Area {
    /// Writes a set: kind and value of each axis.
    pub fn write(&self, counter: u64, axes: &[(u64, f64)]) {
        let commands = &self.commands;
        let sequence = commands.get(5);
        commands.set(5, sequence.wrapping_add(1));
        commands.set(6, counter);
        for (axis, (kind, value)) in axes.iter().enumerate() {
            let at = usize::try_from(commands.get(2)).unwrap() + axis * 4;
            commands.set(at, *kind);
            commands.set(at + 1, value.to_bits());
        }
        commands.set(5, sequence.wrapping_add(2));
    }

    pub fn used(&self) -> u64 {
        self.commands.get(9)
    }
}

/// The samples of an area.
pub struct Rows<'a> {
    area: &'a Area,
    next: u64,
    /// The words of target position and statusword of the axis.
    words: [usize; 2],
}

impl<'a> Rows<'a> {
    pub fn new(area: &'a Area, axis: &str) -> Self {
        let samples = &area.samples;
        let (from, bytes) = (samples.get(8) / 8, samples.get(9));
        let text: Vec<u8> = (from..from + bytes.div_ceil(8))
            .flat_map(|word| samples.get(usize::try_from(word).unwrap()).to_ne_bytes())
            .collect();
        let layout: Value =
            serde_json::from_slice(&text[..usize::try_from(bytes).unwrap()]).unwrap();
        let word = |name: &str| {
            let signals = layout["signals"].as_array().unwrap();
            let name = json!(format!("{axis}.{name}"));
            let signal = signals.iter().find(|signal| signal["name"] == name);
            usize::try_from(signal.unwrap()["word"].as_u64().unwrap()).unwrap()
        };
        Self {
            words: [word("target_position"), word("statusword")],
            next: samples.get(6),
            area,
        }
    }

    /// Returns the next row's target position, and whether the operation is enabled.
    pub fn read(&mut self) -> Option<(f64, bool)> {
        self.read_with_time()
            .map(|(_, target, enabled)| (target, enabled))
    }

    /// Like [`Rows::read`], with the row's time in ns before them.
    pub fn read_with_time(&mut self) -> Option<(u64, f64, bool)> {
        let samples = &self.area.samples;
        if self.next >= samples.get(6) {
            return None;
        }
        let row = samples.get(2) + self.next % samples.get(4) * samples.get(3);
        let row = usize::try_from(row).unwrap();
        self.next += 1;
        assert_eq!(samples.get(row), self.next, "the reader keeps up");
        let [target, status] = self
            .words
            .map(|word| f64::from_bits(samples.get(row + word)));
        Some((samples.get(row + 1), target, status as u64 & 0x6f == 0x27))
    }
}
