//! The mailboxes of a device. ethercrab configures them from the EEPROM. If the ESI has others, the
//! machine file says which ones are used: a mailbox whose length differs from its SyncManager's
//! never becomes full.

use std::future::{Future, poll_fn};
use std::pin::pin;
use std::task::Poll;
use std::time::Duration;

use ecaxis_ecat::registers;
use ecaxis_esi::model::{SmUse, SyncManager};

use super::device::{read, write};
use super::process_data::RegisterBlock;
use super::{Step, name_at};
use crate::acyclic::enumerate::read_device;
use crate::acyclic::{AlState, DeviceRef, StateTimeouts, al};
use crate::config::{DeviceConfig, Locator, Machine, MailboxSource};
use crate::datagram::DatagramClient;
use crate::mailbox::{MailboxLayout, MailboxTransport};
use crate::report::{Cause, Error};

const STEP: &str = "configuring the mailbox";

/// The mailbox SyncManagers of an ESI, with their numbers.
#[derive(Debug, Clone, Copy)]
struct EsiMailbox<'c> {
    out: (u8, &'c SyncManager),
    inp: (u8, &'c SyncManager),
}

impl<'c> EsiMailbox<'c> {
    fn of(config: &'c DeviceConfig) -> Option<Self> {
        config.device.mailbox.as_ref()?;
        let find = |usage| {
            let mut sms = (0..=u8::MAX).zip(&config.device.sync_managers);
            sms.find(|(_, sm)| sm.usage == usage)
        };
        Some(Self {
            out: find(SmUse::MBoxOut)?,
            inp: find(SmUse::MBoxIn)?,
        })
    }

    /// Writes both SyncManagers and enables them. No device with a mailbox reaches PreOp without it
    /// (ETG.1000.6, 6.4), whatever the ESI's `Enable` says. The device must be in Init.
    async fn configure(
        &self,
        wire: &impl MailboxTransport,
        device: &DeviceRef,
    ) -> Result<(), Error> {
        for block in self.registers() {
            // The other registers of an enabled SyncManager cannot be written (ETG.1000.4).
            write(wire, device, STEP, block.register + ACTIVATE, &[0]).await?;
            write(wire, device, STEP, block.register, &block.data).await?;
        }
        Ok(())
    }

    fn registers(&self) -> [RegisterBlock; 2] {
        [self.out, self.inp].map(|(number, sm)| {
            let [a0, a1] = sm.start_address.to_le_bytes();
            let [n0, n1] = sm.default_size.to_le_bytes();
            RegisterBlock {
                register: sync_manager(number),
                data: vec![a0, a1, n0, n1, sm.control_byte, 0, 1, 0],
                op_only: None,
            }
        })
    }
}

/// Returns the mailbox SyncManagers of the ESI, out and in; `None` without mailboxes.
#[must_use]
pub fn mailbox_registers(config: &DeviceConfig) -> Option<[RegisterBlock; 2]> {
    EsiMailbox::of(config).map(|mailbox| mailbox.registers())
}

/// The offset of a SyncManager's activate register.
const ACTIVATE: u16 = 6;

fn sync_manager(number: u8) -> u16 {
    registers::SYNC_MANAGER + registers::SYNC_MANAGER_LEN * u16::from(number)
}

/// Returns the mailbox that the device has from now on; `None` if the ESI declares neither
/// CoE nor SoE. `device`
/// is in PreOp before and afterwards.
pub(super) async fn open(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &DeviceRef,
    progress: &dyn Fn(Step),
) -> Result<Option<MailboxLayout>, Error> {
    let Some(esi) = EsiMailbox::of(config).filter(|_| is_used(config)) else {
        return Ok(None);
    };
    let area = |(_, sm): (u8, &SyncManager)| (sm.start_address, sm.default_size);
    let expected = (area(esi.out), area(esi.inp));
    let mut actual = configured(wire, device, &esi).await?;
    if actual != expected {
        let differs = format!(
            "{device}: the mailboxes differ: {} in the ESI, {} by the EEPROM",
            show(expected),
            show(actual)
        );
        let used = match config.mailbox {
            MailboxSource::Esi => {
                reconfigure(wire, config, device, &esi).await?;
                actual = configured(wire, device, &esi).await?;
                "ESI"
            }
            MailboxSource::Eeprom => "EEPROM",
        };
        let empty = actual.0.1 == 0 || actual.1.1 == 0;
        if empty || config.mailbox == MailboxSource::Esi && actual != expected {
            return Err(Cause::MailboxMoved {
                expected: show(expected),
                actual: show(actual),
            }
            .with_device(device));
        }
        let warning = format!("{differs}; those of the {used} are used (`mailbox`)");
        progress(Step::Warning(warning));
    }
    let ((out_address, out_len), (in_address, in_len)) = actual;
    Ok(Some(MailboxLayout {
        station: device.station,
        out_address,
        out_len,
        in_address,
        in_len,
        out_sm: esi.out.0,
        in_sm: esi.inp.0,
    }))
}

/// Returns the mailbox that a device has by its ESI; `None` without CoE and SoE.
pub(super) fn expected(config: &DeviceConfig, device: &DeviceRef) -> Option<MailboxLayout> {
    let esi = EsiMailbox::of(config).filter(|_| is_used(config))?;
    Some(MailboxLayout {
        station: device.station,
        out_address: esi.out.1.start_address,
        out_len: esi.out.1.default_size,
        in_address: esi.inp.1.start_address,
        in_len: esi.inp.1.default_size,
        out_sm: esi.out.0,
        in_sm: esi.inp.0,
    })
}

/// True if the device has CoE, or SoE alone.
fn is_used(config: &DeviceConfig) -> bool {
    let mailbox = config.device.mailbox.as_ref();
    mailbox.is_some_and(|m| m.coe.is_some() || m.soe.is_some())
}

/// Address and length of both mailboxes, out and in.
type Areas = ((u16, u16), (u16, u16));

fn show((out, inp): Areas) -> String {
    format!(
        "out 0x{:04x} ({} bytes), in 0x{:04x} ({} bytes)",
        out.0, out.1, inp.0, inp.1
    )
}

/// Reads the mailboxes that the device has now.
async fn configured(
    wire: &impl MailboxTransport,
    device: &DeviceRef,
    esi: &EsiMailbox<'_>,
) -> Result<Areas, Error> {
    let area = async |number| {
        let [a0, a1, n0, n1] = read(wire, device, STEP, sync_manager(number)).await?;
        Ok::<_, Error>((u16::from_le_bytes([a0, a1]), u16::from_le_bytes([n0, n1])))
    };
    Ok((area(esi.out.0).await?, area(esi.inp.0).await?))
}

/// Gives a device in PreOp the mailboxes of its ESI. They may change in Init only (ETG.1000.6, 6.4).
async fn reconfigure(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &DeviceRef,
    esi: &EsiMailbox<'_>,
) -> Result<(), Error> {
    let timeouts = StateTimeouts::new(&config.device.info);
    let one = std::slice::from_ref(device);
    al::change_state(wire, one, AlState::Init, timeouts.back_to_init).await?;
    esi.configure(wire, device).await?;
    let done = request_pre_op(wire, config, device).await;
    done.map_err(|error| error.with_action(STEP))
}

/// Takes a device that returns from Init to PreOp, with the mailboxes that it had before.
pub(super) async fn restore(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &DeviceRef,
    before: Option<&MailboxLayout>,
) -> Result<(), Error> {
    if let Some(esi) = EsiMailbox::of(config) {
        let (mut out, mut inp) = (esi.out.1.clone(), esi.inp.1.clone());
        if let Some(before) = before {
            (out.start_address, out.default_size) = (before.out_address, before.out_len);
            (inp.start_address, inp.default_size) = (before.in_address, before.in_len);
        }
        let mailbox = EsiMailbox {
            out: (esi.out.0, &out),
            inp: (esi.inp.0, &inp),
        };
        mailbox.configure(wire, device).await?;
    }
    request_pre_op(wire, config, device).await
}

async fn request_pre_op(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &DeviceRef,
) -> Result<(), Error> {
    /// 0x0500: the PDI has access to the EEPROM, which some devices need for PreOp.
    const PDI: [u8; 1] = [1];
    let timeouts = StateTimeouts::new(&config.device.info);
    let one = std::slice::from_ref(device);
    write(wire, device, STEP, registers::EEPROM_CONFIGURATION, &PDI).await?;
    let done = al::change_state(wire, one, AlState::PreOp, timeouts.pre_op).await;
    write(wire, device, STEP, registers::EEPROM_CONFIGURATION, &[0]).await?;
    done
}

/// Runs ethercrab's `scan`. Meanwhile, a device that refuses PreOp because of its mailbox gets that
/// of its ESI, and is asked again: ethercrab enables only what the EEPROM enables, and an EEPROM
/// may have a mailbox that its device refuses, or none.
pub(super) async fn repair_during<T>(
    wire: &DatagramClient,
    machine: &Machine,
    scan: impl Future<Output = T>,
) -> T {
    if machine
        .devices
        .iter()
        .all(|config| EsiMailbox::of(config).is_none())
    {
        return scan.await;
    }
    let mut scan = pin!(scan);
    let mut repairs = pin!(repair(wire, machine));
    poll_fn(|context| {
        if let Poll::Ready(done) = scan.as_mut().poll(context) {
            return Poll::Ready(done);
        }
        // It never ends.
        let _ = repairs.as_mut().poll(context);
        Poll::Pending
    })
    .await
}

async fn repair(wire: &DatagramClient, machine: &Machine) {
    const PERIOD: Duration = Duration::from_millis(5);
    let mut repaired = vec![false; machine.devices.len()];
    loop {
        wire.delay(PERIOD).await;
        // One datagram asks all devices.
        let Ok(status) = wire.any_status().await else {
            continue;
        };
        if !AlState::has_error(status) {
            continue;
        }
        for (position, repaired) in (0..).zip(&mut repaired) {
            if !*repaired {
                *repaired = repair_one(wire, machine, position).await == Some(());
            }
        }
    }
}

/// Returns `None` if the device does not need a repair, or none is known.
async fn repair_one(wire: &DatagramClient, machine: &Machine, position: u16) -> Option<()> {
    let found = read_device(wire, position).await.ok()?;
    if found.code != al::INVALID_MAILBOX || found.state != AlState::Init {
        return None;
    }
    let device = found.named(name_at(machine, position));
    let here = |config: &&DeviceConfig| match config.at {
        Locator::Position(at) => at == position,
        Locator::Alias(at) => at == found.alias,
        Locator::Id(_) | Locator::Behind(..) => false,
    };
    let config = machine.devices.iter().find(here);
    match config.and_then(|config| Some((config.mailbox, EsiMailbox::of(config)?))) {
        Some((MailboxSource::Esi, esi)) => esi.configure(wire, &device).await.ok()?,
        // Which mailbox it should have is not known: enable those that it has.
        _ => enable(wire, device.station).await?,
    }
    tracing::debug!(%device, "its mailbox is configured again, requesting PreOp");
    al::request(wire, &device, AlState::PreOp).await.ok()
}

/// Enables the configured mailboxes of a device.
async fn enable(wire: &DatagramClient, station: u16) -> Option<()> {
    /// ETG.1000.4, table 58: the mode of mailboxes.
    const MAILBOX: u8 = 2;
    for number in 0..2 {
        let mut sm = [0; registers::SYNC_MANAGER_LEN as usize];
        wire.read(station, sync_manager(number), &mut sm)
            .await
            .ok()?;
        let [_, _, n0, n1, control, _, activate, _] = sm;
        if (n0, n1) != (0, 0) && control & 3 == MAILBOX && activate & 1 == 0 {
            let register = sync_manager(number) + ACTIVATE;
            wire.write(station, register, &[1]).await.ok()?;
        }
    }
    Some(())
}
