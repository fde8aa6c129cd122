//! File access over EtherCAT (ETG.1000.6 §5.8): the files of a device and their server.
//!
//! * `files`: the files, kept over a power cycle
//! * `server`: one transfer at a time, packet by packet
//!
//! A device with a boot loader ([`crate::DeviceOptions::firmware`]) treats files written in
//! Bootstrap as firmware ([`crate::firmware`]). Without a boot loader, a firmware update is stored
//! like any other file and changes nothing else. [`crate::SimDevice::take_written_file`] reports
//! such a file. The simulation may then change 0x1018 and 0x100A through
//! [`crate::SimDevice::set_input`].

mod files;
mod server;

pub use files::FileStore;
pub(crate) use server::{FoeRequest, FoeServer, Target};

/// The file access of a device.
#[derive(Debug, Clone)]
pub struct FoeOptions {
    /// Maximum bytes of all files together, names included.
    pub capacity: usize,
    /// The required password; 0: any password.
    pub password: u32,
    /// Files that are accessible only in Bootstrap, such as firmware.
    pub bootstrap_only: Vec<String>,
    /// Files that cannot be written.
    pub read_only: Vec<String>,
    /// Every n-th data packet of a write is first answered with BUSY, like during erasing; 0: none.
    pub busy_every: u32,
    /// The time in ns in which the first data packet of a write is answered with BUSY.
    pub busy_ns: u64,
    /// The first data packet of a write is refused as if the medium was full.
    pub is_full: bool,
    /// Requests to read or write are refused as illegal.
    pub is_illegal: bool,
}

impl Default for FoeOptions {
    fn default() -> Self {
        Self {
            capacity: 4 << 20,
            password: 0,
            bootstrap_only: Vec::new(),
            read_only: Vec::new(),
            busy_every: 0,
            busy_ns: 0,
            is_full: false,
            is_illegal: false,
        }
    }
}

/// Error codes (ETG.1000.6 table 92; from 0x800C on ETG.1020).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FoeError {
    NotFound = 0x8001,
    AccessDenied = 0x8002,
    DiskFull = 0x8003,
    Illegal = 0x8004,
    PacketNumber = 0x8005,
    BootstrapOnly = 0x8008,
    NoRights = 0x800a,
    Checksum = 0x800c,
    OtherHardware = 0x800d,
    NoHeader = 0x8010,
}

impl FoeError {
    fn text(self) -> &'static str {
        match self {
            Self::NotFound => "not found",
            Self::AccessDenied => "access denied",
            Self::DiskFull => "disk full",
            Self::Illegal => "illegal",
            Self::PacketNumber => "packet number wrong",
            Self::BootstrapOnly => "bootstrap only",
            Self::NoRights => "no rights",
            Self::Checksum => "wrong checksum",
            Self::OtherHardware => "for another device",
            Self::NoHeader => "no firmware header",
        }
    }
}
