//! The steps of one SubDevice on its way from PreOp to SafeOp.

use ecaxis_esi::layout::SmLayout;
use ecaxis_esi::{StartupSdo, address};

use super::{BringUpError, BusDevice, DeviceRef, Step};
use crate::config::{DeviceConfig, StartupWay};
use crate::mailbox::{CoeClient, ObjectAddress, SdoError, Wire, object_name};
use crate::rt::image::Region;

/// FMMU registers (ETG.1000.4, Table 56): 16 bytes each.
const FMMU: u16 = 0x0600;
const FMMU_SIZE: u16 = 16;
/// One that maps nothing, as all are after a reset.
const OFF: [u8; FMMU_SIZE as usize] = [0; FMMU_SIZE as usize];
/// SyncManager registers (ETG.1000.4, Table 58): 8 bytes each.
pub(super) const SYNC_MANAGER: u16 = 0x0800;
pub(super) const SYNC_MANAGER_SIZE: u16 = 8;
const STATUS: u16 = 5;

/// When start-up SDOs are sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Moment {
    /// Before SafeOp is asked for: those of Init → PreOp too, which a mailbox can only take now.
    InPreOp,
    /// Before Op is asked for.
    InSafeOp,
}

/// Downloads the start-up SDOs of one moment in order. The mailbox is emptied before, because a device may have
/// sent emergencies while nobody listened.
pub(super) async fn start_up(
    wire: &impl Wire,
    config: &DeviceConfig,
    device: &mut BusDevice,
    moment: Moment,
    progress: &mut dyn FnMut(Step),
) -> Result<(), BringUpError> {
    let due = |transition: &str| (transition == "SO") == (moment == Moment::InSafeOp);
    let list: Vec<_> = config
        .selection
        .startup
        .iter()
        .filter(|sdo| due(sdo.transition))
        .collect();
    if list.is_empty() && moment == Moment::InSafeOp {
        return Ok(());
    }
    let Some(coe) = device.coe.as_mut() else {
        return Ok(());
    };
    coe.drain(wire)
        .await
        .map_err(|source| BringUpError::Mailbox {
            device: device.at.clone(),
            source,
        })?;
    let mut held = 0;
    for (done, sdo) in list.iter().enumerate() {
        let way = config.startup.way(sdo.index, sdo.sub);
        match start_up_one(wire, &device.at, coe, sdo, way).await? {
            Done::Held => held += 1,
            Done::Unreadable => progress(Step::Warning(format!(
                "{}: {} cannot be read, so it is not verified",
                device.at,
                object(sdo)
            ))),
            Done::Written => {}
        }
        progress(Step::StartUp {
            device: config.name.clone(),
            done: done + 1,
            of: list.len(),
        });
    }
    if held > 0 {
        progress(Step::Held {
            device: config.name.clone(),
            held,
            of: list.len(),
        });
    }
    Ok(())
}

/// What became of a start-up SDO.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Done {
    /// And verified, where that was wanted.
    Written,
    /// The device held it already.
    Held,
    /// Written, and not verified: it cannot be read.
    Unreadable,
}

/// Writes one start-up SDO, unless the device holds it and that is enough; reads it back where that is wanted.
async fn start_up_one(
    wire: &impl Wire,
    at: &DeviceRef,
    coe: &mut CoeClient,
    sdo: &StartupSdo,
    way: StartupWay,
) -> Result<Done, BringUpError> {
    if way.skip_equal
        && let Some(now) = read_back(wire, at, coe, sdo).await?
        && holds(sdo, &now)
    {
        tracing::debug!(device = %at, "{} is held already", object(sdo));
        return Ok(Done::Held);
    }
    download(wire, at, coe, sdo).await?;
    if !way.verify {
        return Ok(Done::Written);
    }
    match read_back(wire, at, coe, sdo).await? {
        None => Ok(Done::Unreadable),
        Some(now) if holds(sdo, &now) => Ok(Done::Written),
        Some(now) => Err(BringUpError::NotHeld {
            device: at.clone(),
            object: object(sdo),
            value: format_value(&sdo.data),
            origin: sdo.origin.clone(),
            holds: format_value(&now),
        }),
    }
}

/// What the device holds; `None` where it does not let it be read.
async fn read_back(
    wire: &impl Wire,
    at: &DeviceRef,
    coe: &mut CoeClient,
    sdo: &StartupSdo,
) -> Result<Option<Vec<u8>>, BringUpError> {
    match coe
        .upload(wire, sdo.index, sdo.sub, sdo.complete_access)
        .await
    {
        Ok(data) => Ok(Some(data)),
        Err(SdoError::Abort { .. }) => Ok(None),
        Err(source) => Err(failed(at, sdo, source)),
    }
}

/// By complete access a device may tell more than was written.
fn holds(sdo: &StartupSdo, now: &[u8]) -> bool {
    if sdo.complete_access {
        now.starts_with(&sdo.data)
    } else {
        now == sdo.data
    }
}

/// `0x6065:00 (Following error window)`, with the ESI's name where it has one.
fn object(sdo: &StartupSdo) -> String {
    let (index, sub) = (sdo.index, sdo.sub);
    if sdo.name.is_empty() {
        return ObjectAddress { index, sub }.to_string();
    }
    format!("{} ({})", address(index, sub), sdo.name)
}

fn failed(at: &DeviceRef, sdo: &StartupSdo, source: SdoError) -> BringUpError {
    let known = || {
        object_name(sdo.index, sdo.sub)
            .unwrap_or_default()
            .to_owned()
    };
    BringUpError::StartUp {
        device: at.clone(),
        index: sdo.index,
        sub: sdo.sub,
        name: if sdo.name.is_empty() {
            known()
        } else {
            sdo.name.clone()
        },
        value: format_value(&sdo.data),
        origin: sdo.origin.clone(),
        source,
    }
}

/// Downloads one start-up SDO.
pub(super) async fn download(
    wire: &impl Wire,
    at: &DeviceRef,
    coe: &mut CoeClient,
    sdo: &StartupSdo,
) -> Result<(), BringUpError> {
    coe.download(wire, sdo.index, sdo.sub, sdo.complete_access, &sdo.data)
        .await
        .map_err(|source| failed(at, sdo, source))?;
    tracing::debug!(
        device = %at,
        "SDO {} {} = {} ({})",
        address(sdo.index, sdo.sub), sdo.name, format_value(&sdo.data), sdo.origin
    );
    Ok(())
}

/// Little-endian bytes as a user writes the number.
fn format_value(data: &[u8]) -> String {
    if data.len() > 8 {
        return format!("{} bytes", data.len());
    }
    let value = data
        .iter()
        .rev()
        .fold(0_u64, |value, &byte| value << 8 | u64::from(byte));
    format!("0x{value:0width$x}", width = data.len() * 2)
}

/// Configures the SyncManagers of the process data, and one FMMU for each; and the one of the mailbox's status, to be read at
/// `status`. Outputs and inputs start at the same logical address.
pub(super) async fn map_process_data(
    wire: &impl Wire,
    config: &DeviceConfig,
    device: &BusDevice,
    region: Option<Region>,
    status: Option<u32>,
) -> Result<(), BringUpError> {
    const READ: u8 = 1;
    const WRITE: u8 = 2;

    let layout = &config.selection.layout;
    let mut fmmus = Vec::new();
    for (sms, kind) in [(&layout.outputs, WRITE), (&layout.inputs, READ)] {
        let mut logical = region.map_or(0, |region| region.logical);
        for sm in sms {
            let register = SYNC_MANAGER + SYNC_MANAGER_SIZE * u16::from(sm.sm);
            write(
                wire,
                device,
                "configuring SyncManagers",
                register,
                &sync_manager(sm),
            )
            .await?;
            if sm.len > 0 {
                fmmus.push(fmmu(logical, sm.start_address, sm.len, kind));
                logical = logical.saturating_add(u32::from(sm.len));
            }
        }
    }
    if let (Some(logical), Some((number, sm))) = (status, config.device.mailbox_status_fmmu()) {
        // The ESI's number, unless the process data has taken that.
        let number = usize::from(number).max(fmmus.len());
        fmmus.resize(number, OFF);
        let register = SYNC_MANAGER + SYNC_MANAGER_SIZE * u16::from(sm) + STATUS;
        fmmus.push(fmmu(logical, register, 1, READ));
    }
    for (i, fmmu) in fmmus.iter().enumerate().filter(|(_, fmmu)| **fmmu != OFF) {
        let register = FMMU + FMMU_SIZE * u16::try_from(i).unwrap_or(u16::MAX / FMMU_SIZE);
        write(wire, device, "configuring FMMUs", register, fmmu).await?;
    }
    Ok(())
}

/// A SyncManager without data stays off: a device refuses an active one of length 0.
fn sync_manager(sm: &SmLayout) -> [u8; SYNC_MANAGER_SIZE as usize] {
    let [p0, p1] = sm.start_address.to_le_bytes();
    let [n0, n1] = sm.len.to_le_bytes();
    [p0, p1, n0, n1, sm.control_byte, 0, u8::from(sm.len > 0), 0]
}

fn fmmu(logical: u32, physical: u16, len: u16, kind: u8) -> [u8; FMMU_SIZE as usize] {
    let [l0, l1, l2, l3] = logical.to_le_bytes();
    let [n0, n1] = len.to_le_bytes();
    let [p0, p1] = physical.to_le_bytes();
    // Start bit 0 to stop bit 7; physical start bit 0; enabled.
    [l0, l1, l2, l3, n0, n1, 0, 7, p0, p1, 0, kind, 1, 0, 0, 0]
}

/// A register write that the device must take.
pub(super) async fn write(
    wire: &impl Wire,
    device: &BusDevice,
    step: &'static str,
    register: u16,
    data: &[u8],
) -> Result<(), BringUpError> {
    taken(
        wire.write(device.at.station, register, data).await,
        device,
        step,
        register,
    )
}

/// A register read that the device must answer.
pub(super) async fn read(
    wire: &impl Wire,
    device: &BusDevice,
    step: &'static str,
    register: u16,
    data: &mut [u8],
) -> Result<(), BringUpError> {
    taken(
        wire.read(device.at.station, register, data).await,
        device,
        step,
        register,
    )
}

fn taken(
    result: Result<u16, crate::mailbox::WireError>,
    device: &BusDevice,
    step: &'static str,
    register: u16,
) -> Result<(), BringUpError> {
    match result {
        Ok(1) => Ok(()),
        Ok(_) => Err(BringUpError::NotTaken {
            device: device.at.clone(),
            step,
            register,
        }),
        Err(source) => Err(BringUpError::Wire {
            device: device.at.clone(),
            step,
            source,
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mailbox::tests::mischief::Mischief;
    use crate::mailbox::tests::server::Server;
    use crate::mailbox::tests::{STATION, block_on, client};

    const HELD: (u16, u8) = (0x6065, 0);
    const WRITE_ONLY: (u16, u8) = (0x2000, 1);

    fn sdo((index, sub): (u16, u8), data: &[u8], name: &str) -> StartupSdo {
        StartupSdo {
            transition: "PS",
            index,
            sub,
            complete_access: false,
            data: data.to_vec(),
            name: name.to_owned(),
            origin: "a test".to_owned(),
        }
    }

    /// What becomes of one SDO, and how many the device was asked for.
    fn done(
        sdo: &StartupSdo,
        verify: bool,
        skip_equal: bool,
        mischief: &[Mischief],
    ) -> (Result<Done, String>, usize) {
        let server = Server::new(
            48,
            &[
                (HELD.0, HELD.1, &[7, 0, 0, 0]),
                (WRITE_ONLY.0, WRITE_ONLY.1, &[0]),
            ],
            mischief,
        );
        let at = DeviceRef {
            name: "x".to_owned(),
            position: 0,
            station: STATION,
        };
        let way = StartupWay { verify, skip_equal };
        let done = block_on(start_up_one(&server, &at, &mut client(), sdo, way));
        (done.map_err(|error| error.to_string()), server.log().len())
    }

    #[test]
    fn what_is_held_is_not_written_where_that_is_enough() {
        let (same, other) = (sdo(HELD, &[7, 0, 0, 0], ""), sdo(HELD, &[8, 0, 0, 0], ""));
        assert_eq!(done(&same, false, true, &[]), (Ok(Done::Held), 1));
        assert_eq!(done(&same, true, true, &[]), (Ok(Done::Held), 1));
        assert_eq!(done(&same, false, false, &[]), (Ok(Done::Written), 1));
        assert_eq!(done(&other, false, true, &[]), (Ok(Done::Written), 2));
        assert_eq!(done(&other, true, true, &[]), (Ok(Done::Written), 3));
    }

    #[test]
    fn what_is_written_and_not_held_is_told_with_its_name() {
        let forgets = [Mischief::Forgetful];
        let known = sdo(HELD, &[8, 0, 0, 0], "");
        let (told, _) = done(&known, true, false, &forgets);
        let told = told.expect_err("it holds another value");
        assert!(
            told.contains("0x6065:00 (Following error window)")
                && told.contains("0x00000008")
                && told.contains("0x00000007"),
            "{told}"
        );
        let named = sdo(HELD, &[8, 0, 0, 0], "Window");
        let told = done(&named, true, false, &forgets).0.expect_err("likewise");
        assert!(told.contains("0x6065:00 (Window)"), "{told}");
        assert_eq!(done(&known, false, false, &forgets), (Ok(Done::Written), 1));
    }

    #[test]
    fn what_cannot_be_read_is_written_and_that_is_said() {
        let secret = sdo(WRITE_ONLY, &[1], "");
        let hidden = [Mischief::WriteOnly(WRITE_ONLY.0)];
        assert_eq!(
            done(&secret, true, true, &hidden),
            (Ok(Done::Unreadable), 3)
        );
    }

    #[test]
    fn errors_name_the_object() {
        let missing = sdo((0x607d, 2), &[0; 4], "");
        let told = done(&missing, false, false, &[])
            .0
            .expect_err("it is not there");
        assert!(told.contains("0x607d:02 Max position limit"), "{told}");
    }
}
