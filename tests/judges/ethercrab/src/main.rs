//! ethercrab's own MainDevice, with its own tasks, on an interface: `judge-ethercrab IF CYCLES`.
//! With `IF PreOp` or `IF SafeOp`, stops in that state and prints the contents of the EEPROMs.
//!
//! Brings every device to Op, exchanges process data, copies a pattern to the last device's
//! outputs, and prints one line per finding for the judges to compare.

mod eeprom;

use std::env;
use std::error::Error;
use std::time::{Duration, Instant};

use ethercrab::std::{ethercat_now, tx_rx_task};
use ethercrab::{MainDevice, MainDeviceConfig, PduStorage, Timeouts};
use smol::Timer;

const MAX_SUBDEVICES: usize = 16;
const PDI: usize = 128;
const PERIOD: Duration = Duration::from_millis(2);
const PATTERN: u8 = 0xa5;

static STORAGE: PduStorage<16, { PduStorage::element_size(1100) }> = PduStorage::new();

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = env::args().skip(1);
    let nic = arguments.next().ok_or("judge-ethercrab IF CYCLES")?;
    let how_far = arguments.next().ok_or("judge-ethercrab IF CYCLES")?;
    let (tx, rx, pdu_loop) = STORAGE.try_split().map_err(|()| "split twice")?;
    // Longer than any stall of this computer.
    let timeouts = Timeouts {
        pdu: Duration::from_secs(1),
        eeprom: Duration::from_secs(1),
        state_transition: Duration::from_secs(10),
        mailbox_response: Duration::from_secs(2),
        mailbox_echo: Duration::from_secs(2),
        ..Timeouts::default()
    };
    let config = MainDeviceConfig {
        dc_static_sync_iterations: 200,
        ..MainDeviceConfig::default()
    };
    let maindevice = MainDevice::new(pdu_loop, timeouts, config);
    smol::spawn(tx_rx_task(&nic, tx, rx)?).detach();
    smol::block_on(async {
        match how_far.as_str() {
            "PreOp" => eeprom::read(&maindevice, false).await,
            "SafeOp" => eeprom::read(&maindevice, true).await,
            cycles => work(&maindevice, cycles.parse()?).await,
        }
    })
}

async fn work(maindevice: &MainDevice<'_>, cycles: u32) -> Result<(), Box<dyn Error>> {
    let group = maindevice
        .init_single_group::<MAX_SUBDEVICES, PDI>(ethercat_now)
        .await?;
    for subdevice in group.iter(maindevice) {
        let id = subdevice.identity();
        println!(
            "device {:#010x} {:#010x} {:#010x}",
            id.vendor_id, id.product_id, id.revision
        );
    }
    let first = group.subdevice(maindevice, 0)?;
    println!("vendor {:#010x}", first.sdo_read::<u32>(0x1018, 1).await?);
    first.sdo_write(0x6065, 0, 4321_u32).await?;
    println!("written {}", first.sdo_read::<u32>(0x6065, 0).await?);

    let group = group.into_safe_op(maindevice).await?;
    println!("SafeOp");
    group.tx_rx(maindevice).await?;
    let group = group.request_into_op(maindevice).await?;
    let mut in_op = false;
    for _ in 0..2_000 {
        let response = group.tx_rx(maindevice).await?;
        in_op = response.all_op();
        if in_op {
            break;
        }
        Timer::after(PERIOD).await;
    }
    println!("{}", if in_op { "Op" } else { "no Op" });

    let last = group.len() - 1;
    group
        .subdevice(maindevice, last)?
        .outputs_raw_mut()
        .fill(PATTERN);
    let mut counters = std::collections::BTreeMap::new();
    let mut next = Instant::now();
    for _ in 0..cycles {
        let response = group.tx_rx(maindevice).await?;
        *counters.entry(response.working_counter).or_insert(0) += 1;
        next += PERIOD;
        Timer::at(next).await;
    }
    for (wkc, count) in counters {
        println!("cycles {count} wkc {wkc}");
    }
    let inputs = group.subdevice(maindevice, last)?.inputs_raw().to_vec();
    println!("inputs {inputs:02x?} for outputs {PATTERN:02x}");
    group
        .into_safe_op(maindevice)
        .await?
        .into_pre_op(maindevice)
        .await?;
    println!("PreOp");
    Ok(())
}
