//! Identity, update methods and running program of a device.

use std::fmt;
use std::time::Duration;

use ecaxis_esi::sii::{self, Protocols, Sii};

use super::FirmwareError;
use ecaxis_master::acyclic::device::with_mailbox;
use ecaxis_master::acyclic::eeprom::{EepromAccess, EepromError, with_eeprom};
use ecaxis_master::acyclic::enumerate::{DeviceSelector, address, enumerate};
use ecaxis_master::acyclic::{DatagramClient, ServiceError};
use ecaxis_master::bringup::{AlState, DeviceRef};
use ecaxis_master::mailbox::{CoeClient, SdoError, Timeouts};

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
    pub silent: Option<ServiceError>,
}

/// Finds a device and reads its identity. Objects are read in PreOp, from Init and back; Bootstrap
/// has no objects. An EEPROM in use by the device is not read, except in Init and Bootstrap.
///
/// # Errors
/// [`FirmwareError::Service`], [`FirmwareError::Eeprom`]. A device without answers is not an error.
pub async fn examine(
    wire: &DatagramClient,
    which: DeviceSelector,
    name: &str,
) -> Result<DeviceIdentity, FirmwareError> {
    look_at(wire, which, name, false).await
}

/// Like [`examine`]; `seize`: takes the EEPROM from the device in any state.
pub(super) async fn look_at(
    wire: &DatagramClient,
    which: DeviceSelector,
    name: &str,
    seize: bool,
) -> Result<DeviceIdentity, FirmwareError> {
    const STEP: &str = "reading its EEPROM";
    let mut found = enumerate(wire).await?;
    address(wire, &mut found).await?;
    let found = which.select_from(&found)?;
    let device = found.named(name);
    let claim = match (seize, found.state) {
        (true, _) | (false, AlState::Bootstrap) => EepromAccess::Force,
        (false, state) => EepromAccess::of(state),
    };
    let has_mailbox = matches!(found.state, AlState::PreOp | AlState::SafeOp | AlState::Op);
    let read = with_eeprom(wire, &device, STEP, claim, async |eeprom| {
        eeprom.image(&mut |_, _| {}).await
    });
    let image: Option<Vec<u8>> = match read.await {
        Ok(image) => Some(image),
        Err(ServiceError::Eeprom {
            source: EepromError::InUse,
            ..
        }) if has_mailbox => None,
        Err(error) => return Err(error.into()),
    };
    let sii = image.as_deref().map(sii::parse).transpose();
    let sii = sii.map_err(|source| FirmwareError::Eeprom {
        device: device.clone(),
        source,
    })?;
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
            Err(error @ ServiceError::Stopped { .. }) => return Err(error.into()),
            Err(error) => examined.silent = Some(error),
        }
    }
    Ok(examined)
}

async fn read_coe_identity(
    wire: &DatagramClient,
    examined: &DeviceIdentity,
) -> Result<CoeIdentity, ServiceError> {
    let DeviceIdentity { device, sii, .. } = examined;
    with_mailbox(wire, device, sii, "asking it who it is", async |lent| {
        lent.coe.set_timeouts(PATIENT);
        let spoken = ask(wire, &mut lent.coe).await;
        spoken.map_err(|source| ServiceError::Sdo {
            device: device.clone(),
            source,
        })
    })
    .await
}

async fn ask(wire: &DatagramClient, coe: &mut CoeClient) -> Result<CoeIdentity, SdoError> {
    let mut spoken = CoeIdentity {
        device_type: number(wire, coe, 0x1000, 0).await?,
        name: text(wire, coe, 0x1008).await?,
        hardware: text(wire, coe, 0x1009).await?,
        software: text(wire, coe, 0x100a).await?,
        identification: number(wire, coe, 0x1f56, 1).await?,
        ..CoeIdentity::default()
    };
    for (sub, value) in (1..).zip(&mut spoken.identity) {
        *value = number(wire, coe, 0x1018, sub).await?;
    }
    let control = number(wire, coe, 0x1f51, 1).await?;
    spoken.control = control.and_then(|value| u8::try_from(value).ok());
    Ok(spoken)
}

/// Reads an object; `None` if the device aborts.
async fn upload(
    wire: &DatagramClient,
    coe: &mut CoeClient,
    index: u16,
    sub: u8,
) -> Result<Option<Vec<u8>>, SdoError> {
    match coe.upload(wire, index, sub, false).await {
        Ok(bytes) => Ok(Some(bytes)),
        Err(SdoError::Abort { .. }) => Ok(None),
        Err(error) => Err(error),
    }
}

async fn number(
    wire: &DatagramClient,
    coe: &mut CoeClient,
    index: u16,
    sub: u8,
) -> Result<Option<u32>, SdoError> {
    let bytes = upload(wire, coe, index, sub).await?;
    Ok(bytes.filter(|b| (1..=4).contains(&b.len())).map(|bytes| {
        let digits = bytes.iter().rev();
        digits.fold(0, |value, byte| value << 8 | u32::from(*byte))
    }))
}

/// Reads a text without unprintable characters.
async fn text(
    wire: &DatagramClient,
    coe: &mut CoeClient,
    index: u16,
) -> Result<Option<String>, SdoError> {
    let bytes = upload(wire, coe, index, 0).await?;
    Ok(bytes.map(|bytes| {
        let text = bytes.split(|b| *b == 0).next().unwrap_or_default();
        let text = String::from_utf8_lossy(text);
        let shown = text.chars().map(|c| if c.is_control() { ' ' } else { c });
        shown.collect::<String>().trim().to_owned()
    }))
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
