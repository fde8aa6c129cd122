//! Reads every EEPROM on a bus with ethercrab, and the registers that ethercrab writes from its
//! contents.

use std::error::Error;

use ethercrab::std::ethercat_now;
use ethercrab::{MainDevice, SubDeviceRef};

const MAX_SUBDEVICES: usize = 64;
const PDI: usize = 16384;
// Most controllers have fewer than eight FMMUs and fewer than eight SyncManagers.
const FMMUS: u16 = 0x0600;
const SYNC_MANAGERS: u16 = 0x0800;

pub async fn read(maindevice: &MainDevice<'_>, map: bool) -> Result<(), Box<dyn Error>> {
    let group = maindevice
        .init_single_group::<MAX_SUBDEVICES, PDI>(ethercat_now)
        .await?;
    println!("PreOp");
    for device in group.iter(maindevice) {
        let id = device.identity();
        println!(
            "device {:08x} {:08x} {:08x}",
            id.vendor_id, id.product_id, id.revision
        );
        println!("name {}", device.name());
        println!(
            "description {}",
            device.description().await?.unwrap_or_default()
        );
        println!("alias {}", device.alias_address());
        let size: u16 = device.eeprom_read(maindevice, 0x003e).await?;
        println!("size {}", (u32::from(size) + 1) * 128);
        sync_managers(&device).await;
    }
    if !map {
        return Ok(());
    }
    let group = group.into_safe_op(maindevice).await?;
    println!("SafeOp");
    for device in group.iter(maindevice) {
        println!(
            "mapped {} {}",
            device.outputs_raw().len(),
            device.inputs_raw().len()
        );
        sync_managers(&device).await;
        for n in 0..8 {
            let Ok(fmmu) = device.register_read::<[u8; 16]>(FMMUS + 16 * n).await else {
                break;
            };
            let [
                _,
                _,
                _,
                _,
                length,
                long,
                _,
                _,
                physical,
                high,
                _,
                direction,
                active,
                ..,
            ] = fmmu;
            if active != 0 && (length, long) != (0, 0) {
                let physical = u16::from_le_bytes([physical, high]);
                println!("fmmu {n} {physical:04x} {direction}");
            }
        }
    }
    Ok(())
}

async fn sync_managers<S>(device: &SubDeviceRef<'_, S>)
where
    S: std::ops::Deref<Target = ethercrab::SubDevice>,
{
    for n in 0..8 {
        let Ok(sm) = device.register_read::<[u8; 8]>(SYNC_MANAGERS + 8 * n).await else {
            break;
        };
        let [start, high, length, long, control, _, activate, _] = sm;
        let (start, length) = (
            u16::from_le_bytes([start, high]),
            u16::from_le_bytes([length, long]),
        );
        if activate & 1 != 0 {
            println!("sm {n} {start:04x} {length} {control:02x}");
        }
    }
}
