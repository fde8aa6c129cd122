//! Drives that need keys of their own, and with them run as every other one: without a fault, such a
//! run succeeds.

use std::fmt::Write as _;

use super::esi;
use super::features::{Keys, REACH};
use super::generate::Draft;

/// Vendor and product of the drive with data of a unit; those of maxon decide about the classes of
/// its objects.
const VENDOR: u32 = 0xfb;
const PRODUCT: u32 = 0x4550_0004;
const REVISION: u32 = 0x0001_0000;

/// Draws one of these drives. True if the axis must be homed.
pub fn draw(draft: &mut Draft, keys: &mut Keys) -> bool {
    match draft.random.below(5) {
        0 => {
            draft.features.push("mode shown enabled");
            keys.hides_mode = true;
            keys.axis += "mode_display = \"enabled\"\n";
            keys.sim += "quirks = { mode_shown_enabled = true }\n";
            false
        }
        1 => {
            draft.features.push("mode without power");
            keys.cycles_power = true;
            keys.axis += "mode_change = \"no-power\"\n";
            keys.sim += "quirks = { mode_without_power = true }\n";
            false
        }
        2 => gear(draft, keys),
        3 => mechanical_end(draft, keys),
        _ => parameters_of_another_unit(draft, keys),
    }
}

/// The encoder counts more than the drive's positions.
fn gear(draft: &mut Draft, keys: &mut Keys) -> bool {
    draft.features.push("gear of the drive");
    let counts = draft.random.pick(&[8000, 65_536, 131_072]);
    keys.esi = add(draft, "gear.xml", esi::with_gear(counts, 2000));
    let _ = writeln!(keys.sim, "quirks = {{ gear_encoder = {counts} }}");
    false
}

/// Homing by a method of the vendor.
fn mechanical_end(draft: &mut Draft, keys: &mut Keys) -> bool {
    draft.features.push("vendor's homing");
    // A velocity towards the end stops at the range.
    keys.endless = false;
    let (method, sign) = draft.random.pick(&[(-3, 1.0), (-4, -1.0)]);
    let home = sign * (REACH - 5.0);
    keys.axis = format!(
        "homing = {{ method = {method}, threshold = 1500, search = 10.0, zero = 5.0, acceleration = 200.0, \
         position = {home:?}, timeout = \"60s\" }}\n"
    );
    // Inside the range of positions before homing and after it.
    let (start, ends) = (sign * (REACH - 10.0), REACH);
    keys.sim = format!(
        "track = {{ start = {start:?}, ends = [{:?}, {ends:?}] }}\n",
        -ends
    );
    true
}

/// The machine has parameters that were read from another unit of the drive.
fn parameters_of_another_unit(draft: &mut Draft, keys: &mut Keys) -> bool {
    draft.features.push("parameters of another unit");
    let mut dump = format!(
        "format = 2\n[device]\nname = \"drive\"\nvendor = {VENDOR}\nproduct = {PRODUCT}\n\
         revision = {REVISION}\nserial = 4711\n[parameters]\n\
         \"0x6065:00\" = {{ name = \"Window\", type = \"UDINT\", access = \"rw\", value = 40000 }}\n"
    );
    for (index, subs) in esi::OF_A_UNIT {
        for sub in subs {
            let value = 1 + draft.random.below(1000);
            let _ = writeln!(
                dump,
                "\"0x{index:04x}:{sub:02x}\" = {{ name = \"Of a unit\", type = \"UDINT\", access = \"rw\", value = {value} }}"
            );
        }
    }
    keys.esi = add(draft, "unit.xml", esi::with_unit_data(VENDOR));
    add(draft, "unit.toml", dump);
    keys.device += "parameters = \"unit.toml\"\n";
    false
}

/// Adds a file to the folder of the machine file.
fn add(draft: &mut Draft, name: &'static str, text: String) -> &'static str {
    draft.files.retain(|file| file.0 != name);
    draft.files.push((name.to_string(), text));
    name
}
