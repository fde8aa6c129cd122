//! Identity, update methods and running program of a device.

use std::fmt;
use std::time::Duration;

use ecaxis_esi::sii::{Protocols, Sii};

use super::FirmwareError;
use ecaxis_master::acyclic::DatagramClient;
use ecaxis_master::acyclic::device::{locate, read_sii_unless_in_use, with_mailbox};
use ecaxis_master::acyclic::eeprom::EepromAccess;
use ecaxis_master::acyclic::{AlState, DeviceRef};
use ecaxis_master::config::Locator;
use ecaxis_master::mailbox::{CoeClient, SdoError, Timeouts};
use ecaxis_master::report::{Cause, Error};

/// The device type (0x1000) of a maxon drive with stopped program; with running program it is
/// 0x00020192.
pub const BOOT_LOADER: u32 = 0x0000_012e;

/// Objects of a running device answer at once.
const PATIENT: Timeouts = Timeouts {
    request: Duration::from_millis(500),
    answer: Duration::from_secs(2),
    transfer: Duration::from_secs(5),
};

/// The expected identity; `None` accepts any.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Expected {
    pub vendor: Option<u32>,
    pub product: Option<u32>,
}

/// The identity objects over CoE; missing objects are `None`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CoeIdentity {
    /// 0x1000.
    pub device_type: Option<u32>,
    /// 0x1008, 0x1009, 0x100A.
    pub name: Option<String>,
    pub hardware: Option<String>,
    pub software: Option<String>,
    /// 0x1018:01 to 04: vendor, product, revision, serial number.
    pub identity: [Option<u32>; 4],
    /// 0x1F51:01: 0 stopped, 1 started.
    pub control: Option<u8>,
    /// 0x1F56:01.
    pub identification: Option<u32>,
}

/// The running program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunningProgram {
    Program,
    /// The program is stopped or missing.
    BootLoader,
    /// The device does not report it.
    Unknown,
}

impl fmt::Display for RunningProgram {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Program => "runs its program",
            Self::BootLoader => "runs its boot loader alone",
            Self::Unknown => "does not say what runs in it",
        })
    }
}

/// An examined device. Its state was restored.
#[derive(Debug)]
pub struct DeviceIdentity {
    pub device: DeviceRef,
    /// The content of its EEPROM.
    pub sii: Sii,
    /// True if the device itself uses its EEPROM, so that the content is unknown.
    pub in_use: bool,
    pub state: AlState,
    /// True if it has an unacknowledged error, with this AL status code.
    pub error: bool,
    pub code: u16,
    pub spoken: Option<CoeIdentity>,
    /// Why a device with CoE did not answer.
    pub silent: Option<Error>,
}

/// Finds a device and reads its identity. Objects are read in PreOp, from Init and back; Bootstrap
/// has no objects. An EEPROM in use by the device is not read, except in Init and Bootstrap.
///
/// # Errors
/// As [`locate`] and [`read_sii_unless_in_use`]. A device without answers is not an error.
pub async fn examine(
    wire: &DatagramClient,
    at: Locator,
    name: Option<&str>,
) -> Result<DeviceIdentity, Error> {
    examine_with(wire, at, name, false).await
}

/// Like [`examine`]; `seize`: takes the EEPROM from the device in any state.
pub(super) async fn examine_with(
    wire: &DatagramClient,
    at: Locator,
    name: Option<&str>,
    seize: bool,
) -> Result<DeviceIdentity, Error> {
    let (found, device) = locate(wire, at, name).await?;
    let access = match (seize, found.state) {
        (true, _) | (false, AlState::Bootstrap) => EepromAccess::Force,
        (false, state) => EepromAccess::of(state),
    };
    let sii = read_sii_unless_in_use(wire, &found, &device, access).await?;
    let mut examined = DeviceIdentity {
        state: found.state,
        error: found.error,
        code: found.code,
        spoken: None,
        silent: None,
        device,
        in_use: sii.is_none(),
        sii: sii.unwrap_or_default(),
    };
    let has_coe = examined.in_use || examined.sii.protocols.has(Protocols::COE);
    if has_coe && examined.state != AlState::Bootstrap {
        match read_coe_identity(wire, &examined).await {
            Ok(spoken) => examined.spoken = Some(spoken),
            Err(error) if error.is_interruption() => return Err(error),
            Err(error) => examined.silent = Some(error),
        }
    }
    Ok(examined)
}

async fn read_coe_identity(
    wire: &DatagramClient,
    examined: &DeviceIdentity,
) -> Result<CoeIdentity, Error> {
    let DeviceIdentity { device, sii, .. } = examined;
    with_mailbox(wire, device, sii, "reading its identity", async |lent| {
        lent.coe.set_timeouts(PATIENT);
        let spoken = ask(wire, &mut lent.coe).await;
        spoken.map_err(|error| Cause::Sdo(error).with_device(device))
    })
    .await
}

async fn ask(wire: &DatagramClient, coe: &mut CoeClient) -> Result<CoeIdentity, SdoError> {
    let mut spoken = CoeIdentity {
        device_type: coe.upload_integer(wire, 0x1000, 0).await?,
        name: coe.upload_text(wire, 0x1008).await?,
        hardware: coe.upload_text(wire, 0x1009).await?,
        software: coe.upload_text(wire, 0x100a).await?,
        identification: coe.upload_integer(wire, 0x1f56, 1).await?,
        ..CoeIdentity::default()
    };
    for (sub, value) in (1..).zip(&mut spoken.identity) {
        *value = coe.upload_integer(wire, 0x1018, sub).await?;
    }
    let control = coe.upload_integer(wire, 0x1f51, 1).await?;
    spoken.control = control.and_then(|value| u8::try_from(value).ok());
    Ok(spoken)
}

impl DeviceIdentity {
    #[must_use]
    pub fn runs(&self) -> RunningProgram {
        let Some(spoken) = &self.spoken else {
            return RunningProgram::Unknown;
        };
        match (spoken.control, spoken.device_type) {
            (Some(0), _) | (None, Some(BOOT_LOADER)) => RunningProgram::BootLoader,
            _ => RunningProgram::Program,
        }
    }

    /// Checks the identity by EEPROM and by CoE.
    pub(super) fn check(&self, expected: Expected) -> Result<(), FirmwareError> {
        let other = |by, what: &str, expected: u32, found: u32| FirmwareError::Identity {
            device: self.device.clone(),
            by,
            expected: format!("{what} {expected:#010x}"),
            found: format!("{what} {found:#010x}"),
        };
        let identity = self.sii.identity;
        let [vendor, product, ..] = self.words();
        for (what, wanted, eeprom, words) in [
            ("vendor", expected.vendor, identity.vendor, vendor),
            ("product", expected.product, identity.product, product),
        ] {
            let Some(wanted) = wanted else { continue };
            if eeprom != wanted && !self.in_use {
                return Err(other("its EEPROM", what, wanted, eeprom));
            }
            let (wanted, words) = match words {
                // The low word belongs to the program, which is missing.
                Some(words) if self.runs() == RunningProgram::BootLoader && words & 0xffff == 0 => {
                    (wanted & 0xffff_0000, words)
                }
                Some(words) => (wanted, words),
                None => continue,
            };
            if words != wanted {
                return Err(other("0x1018", what, wanted, words));
            }
        }
        Ok(())
    }

    fn words(&self) -> [Option<u32>; 4] {
        self.spoken.as_ref().map_or([None; 4], |s| s.identity)
    }

    /// Checks that it is still the same device; only the revision may differ.
    pub(super) fn same_as(&self, before: &Self) -> Result<(), FirmwareError> {
        let of = |examined: &Self| {
            let identity = examined.sii.identity;
            (identity.vendor, identity.product, examined.sii.serial)
        };
        let shown = |examined: &Self| {
            let (vendor, product, serial) = of(examined);
            format!("vendor {vendor:#010x}, product {product:#010x}, serial number {serial}")
        };
        if self.in_use || of(self) == of(before) {
            return Ok(());
        }
        Err(FirmwareError::Changed {
            device: self.device.clone(),
            before: shown(before),
            now: shown(self),
        })
    }
}
