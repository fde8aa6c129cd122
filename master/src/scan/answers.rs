//! What a device says of itself over its CoE mailbox.

use ecaxis_axis::scale::Offered;

use super::Device;
use crate::bringup::units;
use crate::mailbox::{CoeClient, SdoError, Wire};

/// Modules of a device; 0xF030 and 0xF050 have no more.
const MOST_MODULES: u8 = 255;
const CONFIGURED: u16 = 0xf030;
const DETECTED: u16 = 0xf050;

const MAXON: u32 = 0xfb;

/// `None`: the device does not have the object, or does not let it be read.
#[derive(Debug, Clone, Default)]
pub struct Answers {
    /// 0x1000: the profile in the low word.
    pub device_type: Option<u32>,
    /// 0x1008 to 0x100A.
    pub name: Option<String>,
    pub hardware: Option<String>,
    pub software: Option<String>,
    /// 0xF030: identities of the modules that it was told of, slot by slot.
    pub configured: Option<Vec<u32>>,
    /// 0xF050: of those that it found.
    pub detected: Option<Vec<u32>>,
    /// Of a CiA 402 drive.
    pub drive: Option<DriveAnswers>,
}

/// What a drive counts in and how far it would go.
#[derive(Debug, Clone, Copy, Default)]
pub struct DriveAnswers {
    pub units: Offered,
    /// maxon's 0x3000:05, counts a turn.
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

/// Asks for everything that a scan wants to know.
///
/// # Errors
/// Where the mailbox fails; refusals are `None`.
pub(super) async fn ask(
    wire: &impl Wire,
    coe: &mut CoeClient,
    device: &Device,
) -> Result<Answers, SdoError> {
    coe.drain(wire).await?;
    let mut answers = Answers {
        device_type: units::value(wire, coe, 0x1000, 0).await?,
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
    wire: &impl Wire,
    coe: &mut CoeClient,
    maxon: bool,
) -> Result<DriveAnswers, SdoError> {
    let low = units::value(wire, coe, 0x607d, 1).await?;
    let high = units::value(wire, coe, 0x607d, 2).await?;
    // `as` keeps the bits: these are signed.
    let software_limits = low.zip(high).map(|(low, high)| [low as i32, high as i32]);
    Ok(DriveAnswers {
        units: units::ask(wire, coe, maxon).await?,
        sensor_resolution: match maxon {
            true => units::value(wire, coe, 0x3000, 5).await?,
            false => None,
        },
        supported_modes: units::value(wire, coe, 0x6502, 0).await?,
        following_window: units::value(wire, coe, 0x6065, 0).await?,
        software_limits,
        max_profile_velocity: units::value(wire, coe, 0x607f, 0).await?,
        max_motor_speed: units::value(wire, coe, 0x6080, 0).await?,
        max_torque: units::value(wire, coe, 0x6072, 0).await?,
        max_acceleration: units::value(wire, coe, 0x60c5, 0).await?,
        max_deceleration: units::value(wire, coe, 0x60c6, 0).await?,
    })
}

/// A text object; without what cannot be printed.
async fn text(
    wire: &impl Wire,
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

/// A list of module identities, slot by slot.
async fn modules(
    wire: &impl Wire,
    coe: &mut CoeClient,
    index: u16,
) -> Result<Option<Vec<u32>>, SdoError> {
    let Some(count) = units::value(wire, coe, index, 0).await? else {
        return Ok(None);
    };
    let count = u8::try_from(count).unwrap_or(MOST_MODULES);
    let mut idents = Vec::with_capacity(usize::from(count));
    for sub in 1..=count {
        let Some(ident) = units::value(wire, coe, index, sub).await? else {
            break;
        };
        idents.push(ident);
    }
    Ok(Some(idents))
}
