//! File access over EtherCAT (ETG.1000.6 §5.8): a device's files and the server that hands them out and takes them in.
//!
//! * `files`: the files, kept over a power cycle
//! * `server`: one transfer at a time, packet by packet
//!
//! A device with a boot loader ([`crate::DeviceOptions::firmware`]) takes what is written in Bootstrap for firmware
//! ([`crate::firmware`]). Without one a firmware update is a file like any other: it comes back byte for byte and changes
//! nothing else. Whoever drives the simulation learns of it from [`crate::SimDevice::take_written_file`] and may then
//! change what the device says of itself (0x1018, 0x100A) through [`crate::SimDevice::store_mut`].

mod files;
mod server;

pub use files::FileStore;
pub(crate) use server::{FoeRequest, FoeServer, Target};

#[derive(Debug, Clone)]
pub struct FoeOptions {
    /// Bytes that all files together may take, names included.
    pub capacity: usize,
    /// What a request must carry; 0: anything.
    pub password: u32,
    /// Files that only Bootstrap may touch, as firmware is.
    pub bootstrap_only: Vec<String>,
    /// Files that cannot be written.
    pub read_only: Vec<String>,
    /// Every n-th data packet of a write is first answered with BUSY, as while flash is erased; 0: none.
    pub busy_every: u32,
}

impl Default for FoeOptions {
    fn default() -> Self {
        Self {
            capacity: 4 << 20,
            password: 0,
            bootstrap_only: Vec::new(),
            read_only: Vec::new(),
            busy_every: 0,
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
