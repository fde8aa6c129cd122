//! The answers of a device over its CoE mailbox.

use ecaxis_axis::scale::DriveUnits;

use super::Device;
use ecaxis_master::bringup::{DETECTED_MODULES, drive_units};
use ecaxis_master::mailbox::{CoeClient, MailboxTransport, SdoError};

const CONFIGURED: u16 = 0xf030;

const MAXON: u32 = 0xfb;

/// The PDOs of a gateway in each direction, 128 bytes each.
const GATEWAY_PDOS: u16 = 4;

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
    /// The process data of a CANopen gateway.
    pub gateway: Option<GatewayInfo>,
}

/// Sizes and state of a CANopen gateway. It shows no object of its CANopen side, such as 0x3000.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GatewayInfo {
    /// Bytes of its inputs and outputs, control and status word included.
    pub inputs: u16,
    pub outputs: u16,
    /// The first byte of the status word: toggle bit, command, extension.
    pub status: u8,
    /// The lowest node in error, 0 without one.
    pub error_node: u8,
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
        device_type: coe.upload_integer(wire, 0x1000, 0).await?,
        name: coe.upload_text(wire, 0x1008).await?,
        hardware: coe.upload_text(wire, 0x1009).await?,
        software: coe.upload_text(wire, 0x100a).await?,
        configured: coe.upload_list(wire, CONFIGURED).await?,
        detected: coe.upload_list(wire, DETECTED_MODULES).await?,
        drive: None,
        gateway: None,
    };
    let profile = answers.device_type.map(|t| t & 0xffff);
    if profile == Some(402) || device.says_drive() {
        let maxon = device.identity().is_some_and(|i| i.vendor == MAXON);
        answers.drive = Some(drive(wire, coe, maxon).await?);
    }
    // A gateway has no profile.
    if answers.device_type == Some(0) {
        answers.gateway = gateway(wire, coe).await?;
    }
    Ok(answers)
}

/// Returns `None` if the process data are not the bytes of a gateway.
async fn gateway(
    wire: &impl MailboxTransport,
    coe: &mut CoeClient,
) -> Result<Option<GatewayInfo>, SdoError> {
    let mut sizes = [0; 2];
    for (size, (pdo, byte)) in sizes
        .iter_mut()
        .zip([(0x1a00, 0x2000_0108), (0x1600, 0x2100_0108)])
    {
        if coe.upload_integer(wire, pdo, 1).await? != Some(byte) {
            return Ok(None);
        }
        for n in 0..GATEWAY_PDOS {
            let bytes = coe.upload_integer(wire, pdo + n, 0).await?;
            *size += bytes.and_then(|n| u16::try_from(n).ok()).unwrap_or(0);
        }
    }
    let status = coe.upload_integer(wire, 0x2000, 1).await?;
    let error_node = coe.upload_integer(wire, 0x2000, 2).await?;
    let [inputs, outputs] = sizes;
    Ok(Some(GatewayInfo {
        inputs,
        outputs,
        status: status.unwrap_or(0) as u8,
        error_node: error_node.unwrap_or(0) as u8,
    }))
}

async fn drive(
    wire: &impl MailboxTransport,
    coe: &mut CoeClient,
    maxon: bool,
) -> Result<DriveInfo, SdoError> {
    let low = coe.upload_integer(wire, 0x607d, 1).await?;
    let high = coe.upload_integer(wire, 0x607d, 2).await?;
    // `as` keeps the bits: these values are signed.
    let software_limits = low.zip(high).map(|(low, high)| [low as i32, high as i32]);
    Ok(DriveInfo {
        units: drive_units::ask(wire, coe, 0, maxon).await?,
        sensor_resolution: match maxon {
            true => coe.upload_integer(wire, 0x3000, 5).await?,
            false => None,
        },
        supported_modes: coe.upload_integer(wire, 0x6502, 0).await?,
        following_window: coe.upload_integer(wire, 0x6065, 0).await?,
        software_limits,
        max_profile_velocity: coe.upload_integer(wire, 0x607f, 0).await?,
        max_motor_speed: coe.upload_integer(wire, 0x6080, 0).await?,
        max_torque: coe.upload_integer(wire, 0x6072, 0).await?,
        max_acceleration: coe.upload_integer(wire, 0x60c5, 0).await?,
        max_deceleration: coe.upload_integer(wire, 0x60c6, 0).await?,
    })
}
