//! The answers of a device over its CoE mailbox.

use ecaxis_axis::scale::DriveUnits;

use super::Device;
use ecaxis_master::bringup::drive_units;
use ecaxis_master::mailbox::{CoeClient, MailboxTransport, SdoError};

/// The maximum number of modules; 0xF030 and 0xF050 have no more subindices.
const MOST_MODULES: u8 = 255;
const CONFIGURED: u16 = 0xf030;
const DETECTED: u16 = 0xf050;

const MAXON: u32 = 0xfb;

/// `None`: the object is missing or not readable.
#[derive(Debug, Clone, Default)]
pub struct CoeInfo {
    /// 0x1000; the low word is the profile.
    pub device_type: Option<u32>,
    /// 0x1008 to 0x100A.
    pub name: Option<String>,
    pub hardware: Option<String>,
    pub software: Option<String>,
    /// 0xF030: identities of the configured modules by slot.
    pub configured: Option<Vec<u32>>,
    /// 0xF050: identities of the detected modules.
    pub detected: Option<Vec<u32>>,
    /// The answers of a CiA 402 drive.
    pub drive: Option<DriveInfo>,
}

/// Units and limits of a drive.
#[derive(Debug, Clone, Copy, Default)]
pub struct DriveInfo {
    pub units: DriveUnits,
    /// 0x3000:05 of maxon drives in counts per turn.
    pub sensor_resolution: Option<u32>,
    /// 0x6502.
    pub supported_modes: Option<u32>,
    /// 0x6065, counts.
    pub following_window: Option<u32>,
    /// 0x607D, counts.
    pub software_limits: Option<[i32; 2]>,
    /// 0x607F, in the unit of 0x60A9.
    pub max_profile_velocity: Option<u32>,
    /// 0x6080, rpm.
    pub max_motor_speed: Option<u32>,
    /// 0x6072, a thousandth of the rated torque.
    pub max_torque: Option<u32>,
    /// 0x60C5 and 0x60C6, in the unit of 0x60AA.
    pub max_acceleration: Option<u32>,
    pub max_deceleration: Option<u32>,
}

/// Reads all objects that a scan uses.
///
/// # Errors
/// Fails if the mailbox fails. Refused objects are `None`.
pub(super) async fn ask(
    wire: &impl MailboxTransport,
    coe: &mut CoeClient,
    device: &Device,
) -> Result<CoeInfo, SdoError> {
    coe.drain(wire).await?;
    let mut answers = CoeInfo {
        device_type: drive_units::value(wire, coe, 0x1000, 0).await?,
        name: text(wire, coe, 0x1008).await?,
        hardware: text(wire, coe, 0x1009).await?,
        software: text(wire, coe, 0x100a).await?,
        configured: modules(wire, coe, CONFIGURED).await?,
        detected: modules(wire, coe, DETECTED).await?,
        drive: None,
    };
    let profile = answers.device_type.map(|t| t & 0xffff);
    if profile == Some(402) || device.says_drive() {
        let maxon = device.identity().is_some_and(|i| i.vendor == MAXON);
        answers.drive = Some(drive(wire, coe, maxon).await?);
    }
    Ok(answers)
}

async fn drive(
    wire: &impl MailboxTransport,
    coe: &mut CoeClient,
    maxon: bool,
) -> Result<DriveInfo, SdoError> {
    let low = drive_units::value(wire, coe, 0x607d, 1).await?;
    let high = drive_units::value(wire, coe, 0x607d, 2).await?;
    // `as` keeps the bits: these values are signed.
    let software_limits = low.zip(high).map(|(low, high)| [low as i32, high as i32]);
    Ok(DriveInfo {
        units: drive_units::ask(wire, coe, maxon).await?,
        sensor_resolution: match maxon {
            true => drive_units::value(wire, coe, 0x3000, 5).await?,
            false => None,
        },
        supported_modes: drive_units::value(wire, coe, 0x6502, 0).await?,
        following_window: drive_units::value(wire, coe, 0x6065, 0).await?,
        software_limits,
        max_profile_velocity: drive_units::value(wire, coe, 0x607f, 0).await?,
        max_motor_speed: drive_units::value(wire, coe, 0x6080, 0).await?,
        max_torque: drive_units::value(wire, coe, 0x6072, 0).await?,
        max_acceleration: drive_units::value(wire, coe, 0x60c5, 0).await?,
        max_deceleration: drive_units::value(wire, coe, 0x60c6, 0).await?,
    })
}

/// Reads a text object and removes unprintable characters.
async fn text(
    wire: &impl MailboxTransport,
    coe: &mut CoeClient,
    index: u16,
) -> Result<Option<String>, SdoError> {
    match coe.upload(wire, index, 0, false).await {
        Ok(data) => {
            let text = String::from_utf8_lossy(&data);
            let text = text.trim_matches(|c: char| c.is_whitespace() || c == '\0');
            let text: String = text.chars().filter(|c| !c.is_control()).take(80).collect();
            Ok((!text.is_empty()).then_some(text))
        }
        Err(SdoError::Abort { .. }) => Ok(None),
        Err(error) => Err(error),
    }
}

/// Reads a list of module identities by slot.
async fn modules(
    wire: &impl MailboxTransport,
    coe: &mut CoeClient,
    index: u16,
) -> Result<Option<Vec<u32>>, SdoError> {
    let Some(count) = drive_units::value(wire, coe, index, 0).await? else {
        return Ok(None);
    };
    let count = u8::try_from(count).unwrap_or(MOST_MODULES);
    let mut idents = Vec::with_capacity(usize::from(count));
    for sub in 1..=count {
        let Some(ident) = drive_units::value(wire, coe, index, sub).await? else {
            break;
        };
        idents.push(ident);
    }
    Ok(Some(idents))
}
