//! Who a device is, what it offers, and what runs in it.

use std::fmt;
use std::time::Duration;

use ecaxis_esi::sii::{self, Protocols, Sii};

use super::FirmwareError;
use crate::bringup::{AlState, DeviceRef};
use crate::mailbox::{CoeClient, SdoError, Timeouts};
use crate::service::device::with_mailbox;
use crate::service::eeprom::{Claim, EepromError, with_eeprom};
use crate::service::station::{Which, address, census};
use crate::service::{Datagrams, ServiceError};

/// Device type (0x1000) of a drive of maxon while its program is stopped; with its program it is 0x00020192.
pub const BOOT_LOADER: u32 = 0x0000_012e;

/// Objects of a device that runs answer at once.
const PATIENT: Timeouts = Timeouts {
    request: Duration::from_millis(500),
    answer: Duration::from_secs(2),
    transfer: Duration::from_secs(5),
};

/// Which device is meant, as far as it is known.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Expected {
    pub vendor: Option<u32>,
    pub product: Option<u32>,
}

/// What a device says of itself over CoE; what it does not have is `None`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Spoken {
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

/// What runs in a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Runs {
    Program,
    /// Its program is stopped, or there is none.
    BootLoader,
    /// It does not say.
    Unknown,
}

impl fmt::Display for Runs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Program => "runs its program",
            Self::BootLoader => "runs its boot loader alone",
            Self::Unknown => "does not say what runs in it",
        })
    }
}

/// A device as it was found. It is left in the state that it was in.
#[derive(Debug)]
pub struct Examined {
    pub device: DeviceRef,
    /// What its EEPROM says.
    pub sii: Sii,
    /// It was using its EEPROM itself, which was left to it: nothing is known of what that says.
    pub in_use: bool,
    pub state: AlState,
    /// It holds an error that nobody has acknowledged, with this AL status code.
    pub error: bool,
    pub code: u16,
    pub spoken: Option<Spoken>,
    /// Why it did not speak though it has CoE.
    pub silent: Option<ServiceError>,
}

/// Finds a device and asks it who it is. Its objects are read in PreOp, to which it goes from Init and back; in Bootstrap it has none.
/// An EEPROM that the device is using itself is left to it, except in Init and Bootstrap.
///
/// # Errors
/// [`FirmwareError::Service`], [`FirmwareError::Eeprom`]; a device that does not speak is no error.
pub async fn examine(
    wire: &Datagrams,
    which: Which,
    name: &str,
) -> Result<Examined, FirmwareError> {
    look_at(wire, which, name, false).await
}

/// Likewise; `seize`: its EEPROM is taken from the device in any state.
pub(super) async fn look_at(
    wire: &Datagrams,
    which: Which,
    name: &str,
    seize: bool,
) -> Result<Examined, FirmwareError> {
    const STEP: &str = "reading its EEPROM";
    let mut found = census(wire).await?;
    address(wire, &mut found).await?;
    let found = which.among(&found)?;
    let device = found.named(name);
    let claim = match (seize, found.state) {
        (true, _) | (false, AlState::Bootstrap) => Claim::Force,
        (false, state) => Claim::of(state),
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
    let mut examined = Examined {
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
        match listen(wire, &examined).await {
            Ok(spoken) => examined.spoken = Some(spoken),
            Err(error @ ServiceError::Stopped { .. }) => return Err(error.into()),
            Err(error) => examined.silent = Some(error),
        }
    }
    Ok(examined)
}

async fn listen(wire: &Datagrams, examined: &Examined) -> Result<Spoken, ServiceError> {
    let Examined { device, sii, .. } = examined;
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

async fn ask(wire: &Datagrams, coe: &mut CoeClient) -> Result<Spoken, SdoError> {
    let mut spoken = Spoken {
        device_type: number(wire, coe, 0x1000, 0).await?,
        name: text(wire, coe, 0x1008).await?,
        hardware: text(wire, coe, 0x1009).await?,
        software: text(wire, coe, 0x100a).await?,
        identification: number(wire, coe, 0x1f56, 1).await?,
        ..Spoken::default()
    };
    for (sub, value) in (1..).zip(&mut spoken.identity) {
        *value = number(wire, coe, 0x1018, sub).await?;
    }
    let control = number(wire, coe, 0x1f51, 1).await?;
    spoken.control = control.and_then(|value| u8::try_from(value).ok());
    Ok(spoken)
}

/// `None` where the device aborts: it has no such object, or not now.
async fn upload(
    wire: &Datagrams,
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
    wire: &Datagrams,
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

/// As far as a terminal can show it.
async fn text(
    wire: &Datagrams,
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

impl Examined {
    #[must_use]
    pub fn runs(&self) -> Runs {
        let Some(spoken) = &self.spoken else {
            return Runs::Unknown;
        };
        match (spoken.control, spoken.device_type) {
            (Some(0), _) | (None, Some(BOOT_LOADER)) => Runs::BootLoader,
            _ => Runs::Program,
        }
    }

    /// Whether this is the device that is meant, by its EEPROM and by its own words.
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
                // The low word belongs to the program, and there is none.
                Some(words) if self.runs() == Runs::BootLoader && words & 0xffff == 0 => {
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

    /// Whether this is still the device that it was; its revision may be another.
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
