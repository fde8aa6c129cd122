//! The program that leads EtherCAT frames to an AF_XDP socket: assembled by hand and loaded by bpf(2), so that neither a
//! compiler for it nor a library is needed.

use std::io;
use std::os::fd::{AsFd, AsRawFd, FromRawFd, OwnedFd};

/// The program on an interface that leads EtherCAT frames to a socket and lets the rest pass. Gone when this is dropped.
#[derive(Debug)]
pub struct Program {
    /// Attaches the program as long as it is open.
    _link: OwnedFd,
    _program: OwnedFd,
    _sockets: OwnedFd,
}

/// bpf(2): commands, types and flags of linux/bpf.h and linux/if_link.h.
mod linux {
    pub(super) const MAP_CREATE: i64 = 0;
    pub(super) const MAP_UPDATE_ELEM: i64 = 2;
    pub(super) const PROG_LOAD: i64 = 5;
    pub(super) const LINK_CREATE: i64 = 28;
    pub(super) const MAP_TYPE_XSKMAP: u32 = 17;
    pub(super) const PROG_TYPE_XDP: u32 = 6;
    pub(super) const ATTACH_XDP: u32 = 37;
    pub(super) const XDP_SKB_MODE: u32 = 1 << 1;
    pub(super) const XDP_PASS: i32 = 2;
    pub(super) const REDIRECT_MAP: i32 = 51;
    pub(super) const PSEUDO_MAP_FD: u8 = 1;

    #[repr(C)]
    #[derive(Default)]
    pub(super) struct MapCreate {
        pub kind: u32,
        pub key_size: u32,
        pub value_size: u32,
        pub max_entries: u32,
        pub flags: u32,
    }

    #[repr(C)]
    #[derive(Default)]
    pub(super) struct MapUpdate {
        pub map: u32,
        pub padding: u32,
        pub key: u64,
        pub value: u64,
        pub flags: u64,
    }

    #[repr(C)]
    #[derive(Default)]
    pub(super) struct ProgramLoad {
        pub kind: u32,
        pub count: u32,
        pub instructions: u64,
        pub license: u64,
        pub log_level: u32,
        pub log_size: u32,
        pub log: u64,
        pub kernel_version: u32,
        pub flags: u32,
    }

    #[repr(C)]
    #[derive(Default)]
    pub(super) struct LinkCreate {
        pub program: u32,
        pub target: u32,
        pub attach_type: u32,
        pub flags: u32,
    }
}

/// One instruction: opcode, destination and source register, offset, immediate.
const fn instruction(opcode: u8, to: u8, from: u8, offset: i16, immediate: i32) -> u64 {
    let [o0, o1] = offset.to_ne_bytes();
    let [i0, i1, i2, i3] = immediate.to_ne_bytes();
    // Registers share a byte, the first in its lower half on machines that count from below.
    let registers = if cfg!(target_endian = "little") {
        from << 4 | to
    } else {
        to << 4 | from
    };
    u64::from_ne_bytes([opcode, registers, o0, o1, i0, i1, i2, i3])
}

/// In: r1 = `xdp_md` (data, data_end, …, rx_queue_index at 16). Out: redirected by queue, or passed on.
fn instructions(sockets: i32, ethertype: u16) -> [u64; 15] {
    const LOAD_WORD: u8 = 0x61;
    const LOAD_HALF: u8 = 0x69;
    const MOVE: u8 = 0xbf;
    const MOVE_NUMBER: u8 = 0xb7;
    const ADD_NUMBER: u8 = 0x07;
    const IF_GREATER: u8 = 0x2d;
    const IF_OTHER: u8 = 0x55;
    const LOAD_64: u8 = 0x18;
    const CALL: u8 = 0x85;
    const EXIT: u8 = 0x95;
    let ethertype = i32::from(ethertype.to_be());
    [
        // r2 = data, r3 = data_end; pass if the Ethernet header does not fit between them.
        instruction(LOAD_WORD, 2, 1, 0, 0),
        instruction(LOAD_WORD, 3, 1, 4, 0),
        instruction(MOVE, 4, 2, 0, 0),
        instruction(ADD_NUMBER, 4, 0, 0, 14),
        instruction(IF_GREATER, 4, 3, 8, 0),
        // Pass if it is another EtherType.
        instruction(LOAD_HALF, 5, 2, 12, 0),
        instruction(IF_OTHER, 5, 0, 6, ethertype),
        // redirect_map(r1 = sockets, r2 = queue, r3 = what to do where that has no socket)
        instruction(LOAD_WORD, 2, 1, 16, 0),
        instruction(LOAD_64, 1, linux::PSEUDO_MAP_FD, 0, sockets),
        instruction(0, 0, 0, 0, 0),
        instruction(MOVE_NUMBER, 3, 0, 0, linux::XDP_PASS),
        instruction(CALL, 0, 0, 0, linux::REDIRECT_MAP),
        instruction(EXIT, 0, 0, 0, 0),
        // Pass.
        instruction(MOVE_NUMBER, 0, 0, 0, linux::XDP_PASS),
        instruction(EXIT, 0, 0, 0, 0),
    ]
}

/// One command of bpf(2).
fn call<T>(command: i64, attributes: &T) -> io::Result<i32> {
    // SAFETY: the attributes are those of the command, live through the call, and the length is their size; what they
    // point to is the callers'.
    let result = unsafe {
        libc::syscall(
            libc::SYS_bpf,
            command,
            &raw const *attributes,
            size_of::<T>(),
        )
    };
    i32::try_from(result)
        .ok()
        .filter(|result| *result >= 0)
        .ok_or_else(io::Error::last_os_error)
}

fn descriptor<T>(command: i64, attributes: &T) -> io::Result<OwnedFd> {
    let fd = call(command, attributes)?;
    // SAFETY: commands that make something return a new descriptor, which nothing else owns.
    Ok(unsafe { OwnedFd::from_raw_fd(fd) })
}

fn number(fd: &OwnedFd) -> u32 {
    fd.as_raw_fd().unsigned_abs()
}

impl Program {
    /// Leads frames of one EtherType that arrive in a queue of an interface to `socket`. Generic XDP: any interface will do.
    ///
    /// # Errors
    /// What bpf(2) says; `ResourceBusy` where the interface has another program.
    pub fn attach(
        interface: i32,
        queue: u32,
        ethertype: u16,
        socket: &impl AsFd,
    ) -> io::Result<Self> {
        let map = linux::MapCreate {
            kind: linux::MAP_TYPE_XSKMAP,
            key_size: 4,
            value_size: 4,
            max_entries: queue + 1,
            flags: 0,
        };
        let sockets = descriptor(linux::MAP_CREATE, &map)?;
        let value = socket.as_fd().as_raw_fd().unsigned_abs();
        let entry = linux::MapUpdate {
            map: number(&sockets),
            key: (&raw const queue).expose_provenance() as u64,
            value: (&raw const value).expose_provenance() as u64,
            ..linux::MapUpdate::default()
        };
        call(linux::MAP_UPDATE_ELEM, &entry)?;

        let instructions = instructions(sockets.as_raw_fd(), ethertype);
        let license = c"Dual MIT/GPL";
        let load = linux::ProgramLoad {
            kind: linux::PROG_TYPE_XDP,
            count: instructions.len() as u32,
            instructions: instructions.as_ptr().expose_provenance() as u64,
            license: license.as_ptr().expose_provenance() as u64,
            ..linux::ProgramLoad::default()
        };
        let program = descriptor(linux::PROG_LOAD, &load)?;
        let link = linux::LinkCreate {
            program: number(&program),
            target: interface.unsigned_abs(),
            attach_type: linux::ATTACH_XDP,
            flags: linux::XDP_SKB_MODE,
        };
        let link = descriptor(linux::LINK_CREATE, &link)?;
        Ok(Self {
            _link: link,
            _program: program,
            _sockets: sockets,
        })
    }
}
