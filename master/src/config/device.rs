//! One device: its ESI file, its entry there, mode, PDOs, start-up SDOs.

use std::sync::Arc;

use ecaxis_ecat::index::{DeviceIndex, IndexVec};
use ecaxis_ecat::mailbox::soe::Idn;
use ecaxis_esi as esi;
use ecaxis_esi::{Field, Layout};
use toml::Spanned;

use super::duration::show;
use super::fields::{Key, KeyExt};
use super::needed::{self, Needs};
use super::problem::{Problems, Span, suggestion};
use super::raw::{RawDevice, RawEntry, SdoValue};
use super::{DeviceConfig, Locator, MailboxSource, Startup, cycle_objects, eoe, gateway, sdo, sim};
use crate::esi_library::{RevisionMatch, SiiImage};
use crate::rt::config::ProcessDataCopy;

mod axes;
mod esi_files;
mod findings;
mod watchdog;

pub(crate) use axes::CheckedAxis;
pub(crate) use esi_files::EsiFiles;
use esi_files::OwnedQuery;

/// A device and its axes, checked. Parts that are invalid have been reported.
pub(crate) struct CheckedDevice {
    pub name: Option<String>,
    pub device: Option<DeviceConfig>,
    pub axes: Vec<CheckedAxis>,
}

pub(crate) fn check(
    mut raw: RawDevice,
    at: Option<Locator>,
    files: &mut EsiFiles<'_>,
    (names, needs): (&[String], &Needs),
    p: &mut Problems<'_>,
) -> CheckedDevice {
    let name = raw.name.as_ref().map(|name| name.get_ref().clone());
    let numbers = axes::numbers(&raw, p);
    let mode = mode(&raw, p);
    let image = files.image(&raw, p);
    let file = files.file(&raw, image.as_deref(), p);
    let device = file.as_ref().and_then(|(_, file)| find(&raw, file, p));
    let sized = device.and_then(|device| gateway::with_sizes(&raw, device));
    let device = sized.as_ref().or(device);
    let mut chosen = match (&file, device, mode, &files.cycle) {
        (Some((_, file)), Some(device), Ok(mode), Some((cycle_ns, cycle))) => {
            let wanted = DeviceQuery {
                raw: &raw,
                mode,
                axes: &numbers,
                needs,
                cycle_ns: *cycle_ns,
                cycle: cycle.clone(),
            };
            wanted.select(file, device, p)
        }
        _ => None,
    };
    let mailbox = raw.mailbox.value().unwrap_or_default();
    let mut axes = axes::check(&raw, &numbers, mode.ok().flatten(), chosen.as_mut(), p);
    if let Some(chosen) = chosen.as_mut() {
        let damage = image.iter().filter_map(|image| image.sii.damage.first());
        let damage = damage.map(|damage| format!("the EEPROM image is damaged: {damage}"));
        chosen.notes.extend(damage);
        let sii = image.as_ref().map(|image| &image.sii);
        chosen.notes.extend(sii.and_then(findings::checksum));
        chosen
            .notes
            .extend(mailbox_note(device, image.as_deref(), mailbox));
        watchdog::set_trigger(chosen, raw.watchdog_trigger.as_ref(), p);
        let of_image = device.filter(|_| raw.esi.is_none());
        chosen.notes.extend(of_image.and_then(without_pdos));
        if let Some((cycle_ns, _)) = &files.cycle {
            chosen.notes.extend(fixed_sync0(chosen, *cycle_ns));
        }
        chosen.notes.extend(findings::long_shift(chosen));
        further_axes(chosen);
        repeated_outputs(chosen);
        profile_objects(&raw, chosen, p);
        reported_position(&raw, chosen, p);
    }
    if let Some(device) = device {
        findings::mailbox(&raw, device, mailbox, p);
    }
    if let (Some(chosen), Some((cycle_ns, _))) = (chosen.as_ref(), &files.cycle) {
        let setups = axes.iter().filter_map(|axis| axis.setup.as_ref());
        cycle_objects::check(&raw, chosen, &setups.collect::<Vec<_>>(), *cycle_ns, p);
    }
    let notes = chosen.as_mut().map(|chosen| &mut chosen.notes);
    let eoe = eoe::device(&raw, device, notes, p);
    let described = file.as_ref().map(|(_, file)| &**file).zip(device);
    let sim = raw.sim.take().map(|sim| {
        let plugged = match (described, &files.cycle) {
            (Some(described), Some((cycle_ns, _))) => sim::modules(&sim, described, *cycle_ns, p),
            _ => None,
        };
        let axis = match axes.first() {
            None => Err(()),
            Some(axis) => Ok(axis.setup.as_ref()),
        };
        sim::SimSetup {
            modules: plugged,
            ..sim::check(sim, names, axis, p)
        }
    });
    let network = gateway::check(
        &raw,
        device,
        chosen.as_mut(),
        files.cycle.as_ref(),
        files.folder(),
        p,
    );
    let mut startup = Startup::of(&raw);
    for setup in axes.iter().filter_map(|axis| axis.setup.as_ref()) {
        startup.verify(setup.torque_limit.startup());
    }
    let parameters = files.parameters(&raw, device, p);
    let device = device.map(|d| Arc::new(d.clone()));
    let identity = identity(raw.identity.as_ref(), p);
    let mut sim = sim.unwrap_or_default();
    let (gateway, simulated) = match network {
        Some(network) => {
            axes.extend(network.axes);
            (Some(network.setup), Some(network.simulated))
        }
        None => (None, None),
    };
    sim.gateway = simulated;
    let device = (|| {
        let (esi_path, file) = file?;
        Some(DeviceConfig {
            modules_named: raw.modules.is_some(),
            name: raw.name?.into_inner(),
            at: at?,
            esi_path,
            device: device?,
            esi: file,
            sii: image,
            mailbox,
            watchdog_trigger: raw.watchdog_trigger.value().unwrap_or_default(),
            selection: chosen?,
            startup,
            identity: identity?,
            serial: raw.serial.value(),
            parameters: parameters?,
            optional: raw.optional.value().unwrap_or(false) || raw.behind.is_some(),
            sim,
            gateway,
            eoe,
            line: p.line(&raw.span),
        })
    })();
    CheckedDevice { name, device, axes }
}

/// Returns the outputs that repeat an object of another PDO of their device.
pub(super) fn repeats(devices: &IndexVec<DeviceIndex, DeviceConfig>) -> Vec<ProcessDataCopy> {
    let mut repeats = Vec::new();
    for (index, device) in devices.enumerate() {
        let nodes = device.gateway.iter().flat_map(|gateway| &gateway.nodes);
        let nodes = nodes.map(|node| &node.selection.layout);
        let layouts = std::iter::once(&device.selection.layout).chain(nodes);
        let fields = layouts.flat_map(Layout::repeated_outputs);
        repeats.extend(fields.map(|(first, field)| ProcessDataCopy {
            from: (index, first.bit_offset as usize),
            to: (index, field.bit_offset as usize),
            bits: first.bit_len.min(field.bit_len).into(),
        }));
    }
    repeats
}

/// Reports mailboxes that differ between the ESI and a known EEPROM.
fn mailbox_note(
    device: Option<&esi::Device>,
    image: Option<&SiiImage>,
    source: MailboxSource,
) -> Option<String> {
    let difference = image?.sii.mailbox_difference(device?)?;
    Some(match source {
        MailboxSource::Esi => {
            format!("{difference}; those of the ESI are used (`mailbox = \"eeprom\"`: the others)")
        }
        MailboxSource::Eeprom => format!("{difference}; those of the EEPROM are used (`mailbox`)"),
    })
}

/// Reports an EEPROM image without PDOs of a device that exchanges process data: many devices
/// describe their PDOs in the ESI only.
fn without_pdos(device: &esi::Device) -> Option<String> {
    use esi::SmUse::{Inputs, Outputs};
    let mut managers = device.sync_managers.iter();
    let exchanges = managers.any(|sm| matches!(sm.usage, Outputs | Inputs));
    let has_coe = device.mailbox.as_ref().is_some_and(|m| m.coe.is_some());
    let has_none = device.rx_pdos.is_empty() && device.tx_pdos.is_empty();
    (has_none && (exchanges || has_coe)).then(|| {
        "warning: the EEPROM image describes no PDO, so the device exchanges no process data; \
         name the ESI file of its vendor with `esi`"
            .to_owned()
    })
}

/// Reports a SYNC0 cycle that the OpMode fixes and that does not fit the bus cycle. Set-points then
/// arrive at another distance from SYNC0 in each cycle.
fn fixed_sync0(selection: &esi::Selection, cycle_ns: u64) -> Option<String> {
    let dc = selection.dc.as_ref().filter(|dc| dc.activates_sync())?;
    let sync0 = u64::from(dc.sync0_cycle_ns);
    let fits = sync0 == 0 || cycle_ns.is_multiple_of(sync0) || sync0.is_multiple_of(cycle_ns);
    (!fits).then(|| {
        format!(
            "warning: the OpMode \"{}\" ({}) fixes the cycle of SYNC0 at {}, so the bus cycle of {} must be \
             a multiple of it, such as {}",
            dc.name,
            dc.position.origin(),
            show(sync0),
            show(cycle_ns),
            show(cycle_ns.next_multiple_of(sync0))
        )
    })
}

/// Reports objects that a profile mode needs and the process data lacks.
fn profile_objects(raw: &RawDevice, selection: &esi::Selection, p: &mut Problems<'_>) {
    let Some(text) = &raw.mode else { return };
    let missing = needed::profile(text.get_ref()).iter().find_map(|index| {
        let objects = selection.axes.iter();
        let object = objects.map(|number| esi::axis::object(*index, *number));
        let there = |object: &u16| selection.layout.rx.iter().any(|f| f.index == *object);
        let mut missing = object.filter(|object| !there(object));
        missing.next()
    });
    if let Some(missing) = missing {
        let message = format!(
            "mode \"{}\" needs 0x{missing:04X} in the outputs, and they lack it",
            text.get_ref()
        );
        let fields = selection.layout.rx.iter().filter(|field| field.index != 0);
        let all = fields.map(|field| format!("\"0x{:04X}\"", field.index));
        let all = all.chain([format!("\"0x{missing:04X}\"")]);
        let hint = format!(
            "write `pdo.rx = [{}]` if the drive can map it, or begin in \"csp\"",
            all.collect::<Vec<_>>().join(", ")
        );
        p.add_hint(text.span(), message, hint);
    }
}

/// Reports an axis that begins in a position mode and does not report its position.
fn reported_position(raw: &RawDevice, selection: &esi::Selection, p: &mut Problems<'_>) {
    const POSITION: u16 = 0x6064;
    let is_of_positions = matches!(selection.mode, Some(esi::Mode::Csp | esi::Mode::Pp));
    let reports = |axis: &u16| {
        let layout = selection.layout.of_axis(*axis);
        layout.tx_field(POSITION, 0).is_some()
    };
    let missing = selection.axes.iter().find(|axis| !reports(axis));
    if let (true, Some(axis), Some(mode)) = (is_of_positions, missing, &raw.mode) {
        let message = format!(
            "mode \"{}\" needs 0x{:04X} in the inputs, and they lack it",
            mode.get_ref(),
            esi::axis::object(POSITION, *axis)
        );
        let at = raw.pdo.tx.place().unwrap_or(mode.span());
        p.add_hint(at, message, "add it to `pdo.tx`");
    }
}

/// Reports outputs that several PDOs map.
fn repeated_outputs(selection: &mut esi::Selection) {
    let repeats = selection.layout.repeated_outputs().map(|(first, field)| {
        format!(
            "{} is mapped in PDO 0x{:04x} and again in 0x{:04x}: both carry the same value",
            esi::address(field.index, field.sub),
            first.pdo,
            field.pdo,
        )
    });
    let notes: Vec<String> = repeats.collect();
    selection.notes.extend(notes);
}

/// Reports which axes of a drive stay without power.
fn further_axes(selection: &mut esi::Selection) {
    if selection.mode.is_none() {
        return;
    }
    let axes = selection.layout.rx.iter();
    let axes = axes.filter_map(|field| unused_axis(field, selection));
    let controlwords = axes.filter(|(_, object)| *object == 0x6040);
    let notes: Vec<String> = controlwords
        .map(|(n, object)| {
            format!(
                "axis {} of the drive (Controlword 0x{:04x}) is not used: its outputs stay zero, it gets no power",
                n + 1,
                esi::axis::object(object, n)
            )
        })
        .collect();
    selection.notes.extend(notes);
}

/// Returns the axis of an object, counted from 0, and the same object of the first axis, if the
/// machine does not use that axis.
pub(crate) fn unused_axis(field: &Field, selection: &esi::Selection) -> Option<(u16, u16)> {
    esi::axis::of(field.index).filter(|(axis, _)| !selection.axes.contains(axis))
}

/// Returns the rule for revisions; the default is the ESI's own revision.
fn identity(rule: Option<&Spanned<String>>, p: &mut Problems<'_>) -> Option<RevisionMatch> {
    let Some(rule) = rule else {
        return Some(RevisionMatch::Equal);
    };
    let known = rule.get_ref().parse();
    if known.is_err() {
        let message = format!("unknown identity \"{}\"", rule.get_ref());
        let names = ["equal", ">=", "high-word", "low-word", "ignore"];
        let hint = suggestion(rule.get_ref(), names, "rules");
        p.add_hint(rule.span(), message, hint);
    }
    known.ok()
}

/// Returns `Err` if the mode is invalid and has been reported.
fn mode(raw: &RawDevice, p: &mut Problems<'_>) -> Result<Option<esi::Mode>, ()> {
    let possible = |mode: &esi::Mode| *mode != esi::Mode::Hm;
    let Some(text) = &raw.mode else {
        let Some(axis) = raw.axes.0.first() else {
            return Ok(None);
        };
        let message = "an axis needs a `mode` in its [[device]]";
        p.add_hint(
            axis.span.clone(),
            message,
            "add `mode = \"csp\"`, \"csv\" or \"cst\"",
        );
        return Err(());
    };
    match text.get_ref().parse::<esi::Mode>() {
        Ok(mode) if possible(&mode) && !raw.axes.0.is_empty() => Ok(Some(mode)),
        Ok(mode) if possible(&mode) => {
            let message = "a device with a `mode` is a drive and needs a [device.axis]";
            p.add_hint(
                text.span(),
                message,
                "describe the axis, or leave `mode` out for an I/O device",
            );
            Err(())
        }
        Ok(mode) => {
            let message = format!("no axis begins in mode \"{mode}\"");
            let hint = "write \"csp\", \"csv\", \"cst\", \"pp\" or \"pv\"; a step `home` switches by itself";
            p.add_hint(text.span(), message, hint);
            Err(())
        }
        Err(_) => {
            let message = format!("unknown mode \"{}\"", text.get_ref());
            let modes = esi::Mode::ALL.into_iter().filter(possible);
            let hint = suggestion(text.get_ref(), modes.map(esi::Mode::name), "modes");
            p.add_hint(text.span(), message, hint);
            Err(())
        }
    }
}

fn find<'e>(
    raw: &RawDevice,
    file: &'e esi::EsiFile,
    p: &mut Problems<'_>,
) -> Option<&'e esi::Device> {
    let at = raw.type_name.place().or(raw.product.place());
    let at = at.or(raw.revision.place()).or(raw.esi.place());
    let at = at.or(raw.sii.place());
    match esi::find_device(file, &OwnedQuery::new(raw).borrow()) {
        Ok(device) => Some(device),
        Err(e) => {
            let message = e.to_string();
            let at = at.unwrap_or(raw.span.clone());
            match e {
                esi::SelectError::Ambiguous { .. } => {
                    p.add_hint(at, message, "pick one with `type`, `product` or `revision`");
                }
                _ => p.add(at, message),
            }
            None
        }
    }
}

/// The machine file's choices for one device of an ESI file.
struct DeviceQuery<'r> {
    raw: &'r RawDevice,
    mode: Option<esi::Mode>,
    axes: &'r [u16],
    needs: &'r Needs,
    cycle_ns: u64,
    cycle: Span,
}

impl DeviceQuery<'_> {
    fn select(
        &self,
        file: &esi::EsiFile,
        device: &esi::Device,
        p: &mut Problems<'_>,
    ) -> Option<esi::Selection> {
        let entries = |list: &Key<Vec<RawEntry>>| {
            let list = list.as_ref()?.get_ref().iter();
            Some(
                list.map(|e| esi::EntryRef {
                    index: e.index,
                    sub: e.sub,
                })
                .collect::<Vec<_>>(),
            )
        };
        let (rx, tx) = (entries(&self.raw.pdo.rx), entries(&self.raw.pdo.tx));
        let modules = self.raw.modules.as_ref().map(|m| m.get_ref());
        let modules: Option<Vec<&str>> =
            modules.map(|names| names.iter().map(String::as_str).collect());
        let idns = self.idns(device, p)?;
        let mut choice = esi::SelectOptions {
            mode: self.mode,
            axes: self.axes,
            rx: rx.as_deref(),
            tx: tx.as_deref(),
            more_rx: &[],
            more_tx: &[],
            modules: modules.as_deref(),
            assignment: self.raw.assignment.as_ref().map(|a| a.get_ref().as_str()),
            dc_mode: self.raw.dc.as_ref().map(|d| d.get_ref().as_str()),
            cycle_ns: self.cycle_ns,
            sdo: &[],
            idns: &idns,
        };
        let mut first = esi::select(file, device, &choice)
            .map_err(|e| self.report(&e, p))
            .ok()?;
        let added = needed::missing(self.raw, self.axes, self.needs, &first.layout);
        let mut note: Option<&String> = None;
        if let Some(added) = &added {
            // A device whose PDOs cannot carry them stays as it is; the check names what is missing.
            if let Some((selection, more)) = added.select(file, device, choice) {
                (first, choice, note) = (selection, more, Some(&added.note));
            }
        }
        first.notes.extend(note.cloned());
        if self.raw.sdo.is_empty() {
            return Some(first);
        }
        // The dictionary depends on the module, so values are encoded here.
        let mut sdos = Vec::new();
        for raw in &self.raw.sdo {
            let (index, sub) = raw.address();
            let item = first.dictionary.item(index, sub);
            let type_name = raw.type_name.as_ref().map(|t| t.get_ref().as_str());
            match sdo::encode(raw.value.get_ref(), type_name, item) {
                Ok(data) => sdos.push(esi::UserSdo { index, sub, data }),
                Err((message, hint)) => {
                    let message = format!("SDO {}: {message}", esi::address(index, sub));
                    match hint {
                        Some(hint) => p.add_hint(raw.span.clone(), message, hint),
                        None => p.add(raw.value.span(), message),
                    }
                }
            }
        }
        if sdos.len() < self.raw.sdo.len() {
            return None;
        }
        choice.sdo = &sdos;
        let mut selection = esi::select(file, device, &choice)
            .map_err(|e| self.report(&e, p))
            .ok()?;
        selection.notes.extend(note.cloned());
        Some(selection)
    }

    /// Returns the start-up IDNs of the file.
    fn idns(&self, device: &esi::Device, p: &mut Problems<'_>) -> Option<Vec<esi::StartupIdn>> {
        let mut idns = Vec::new();
        for raw in &self.raw.idn {
            if device.soe_only().is_none() {
                let message = format!("{} has no IDNs: it does not speak SoE alone", device.name);
                p.add_hint(raw.span.clone(), message, "write objects with `sdo`");
                return None;
            }
            let Ok(idn) = raw.idn.get_ref().parse::<Idn>() else {
                let message = format!("`{}` is not an IDN", raw.idn.get_ref());
                p.add_hint(
                    raw.idn.span(),
                    message,
                    "write it as \"S-0-0138\" or \"P-0-0150\"",
                );
                return None;
            };
            if let Some(derived) = keys_of_idn(idn) {
                // Another value would give the process data another meaning.
                let message = format!("`{idn}` follows from {derived}");
                p.add_hint(raw.idn.span(), message, "remove it from `idn`");
                return None;
            }
            idns.push(esi::StartupIdn {
                transition: "PS",
                drive: raw.drive.value().unwrap_or(0),
                idn,
                value: match raw.value.get_ref() {
                    SdoValue::Integer(n) => esi::IdnValue::Text(n.to_string()),
                    SdoValue::Float(n) => esi::IdnValue::Text(n.to_string()),
                    SdoValue::Boolean(b) => esi::IdnValue::Text(u8::from(*b).to_string()),
                    SdoValue::Text(text) => esi::IdnValue::Text(text.clone()),
                    SdoValue::Bytes(bytes) => esi::IdnValue::Bytes(bytes.clone()),
                },
                origin: "idn of the machine file".to_owned(),
            });
        }
        Some(idns)
    }

    fn report(&self, e: &esi::SelectError, p: &mut Problems<'_>) {
        use esi::SelectError as E;
        let raw = self.raw;
        let device = raw.esi.place().or(raw.sii.place());
        let device = device.unwrap_or(raw.span.clone());
        let of = |value: Option<Span>| value.unwrap_or(device.clone());
        let entries = |name: &str| match name.contains("rx") {
            true => &raw.pdo.rx,
            false => &raw.pdo.tx,
        };
        let list = |name: &str| of(entries(name).place());
        let entry = |name: &str, index: u16, sub: u8| {
            let mut entries = entries(name).iter().flat_map(Spanned::get_ref);
            let found = entries.find(|e| (e.index, e.sub) == (index, sub));
            found.map_or(list(name), |e| e.span.clone())
        };
        let sdo = |index: u16, sub: u8| {
            let found = raw.sdo.iter().find(|s| s.address() == (index, sub));
            of(found.map(|s| s.span.clone()))
        };
        let at = match e {
            E::ModeNotOffered { .. } | E::NoControlword { .. } | E::SubindexOfValue { .. } => {
                of(raw.mode.place())
            }
            E::NoSuchAxis { number, .. } => {
                let numbers = (1..).zip(&raw.axes.0);
                let mut numbered =
                    numbers.map(|(n, axis)| (axis.number.value().unwrap_or(n), axis));
                let axis = numbered.find(|(own, _)| own == number);
                of(axis.map(|(_, axis)| axis.span.clone()))
            }
            E::NoSuchDcMode { .. } => of(raw.dc.place()),
            E::NoSuchModule { .. } | E::TooManyModules { .. } | E::ModuleMode { .. } => {
                of(raw.modules.place())
            }
            E::NoSuchAssignment { .. } => of(raw.assignment.place()),
            E::CycleNotExpressible { .. } | E::SoeCycle { .. } | E::DcOutOfRange { .. } => {
                self.cycle.clone()
            }
            E::UnknownEntry { list, index, sub }
            | E::NotMappable {
                list, index, sub, ..
            } => entry(list, *index, *sub),
            E::NotConfigurable { list: name, .. }
            | E::TooManyEntries { list: name, .. }
            | E::MissingEntry { list: name, .. } => list(name),
            E::SdoLength { index, sub, .. } | E::SoeOnly { index, sub, .. } => sdo(*index, *sub),
            _ => device.clone(),
        };
        match e {
            E::ModuleNeeded { .. } => p.add_hint(
                at,
                e.to_string(),
                "pick one by its mode (`mode = \"csp\"`), or name the modules slot by slot (`modules = [\"CSP\"]`)",
            ),
            E::ModuleMode { .. } => p.add_hint(
                at,
                e.to_string(),
                "name the module of `mode`, or leave `modules` out",
            ),
            E::ModeNotOffered { .. } => p.add_hint(
                at,
                e.to_string(),
                "pick another mode, or the ESI file of the drive; an I/O device has no `mode` and no [device.axis]",
            ),
            E::NoControlword { .. } | E::SubindexOfValue { .. } => p.add_hint(
                at,
                e.to_string(),
                "get a correct ESI file from the vendor, or pick another mode",
            ),
            _ => p.add(at, e.to_string()),
        }
    }
}

/// Returns the keys from which the value of an IDN follows.
#[must_use]
pub fn keys_of_idn(idn: Idn) -> Option<&'static str> {
    match idn {
        Idn::CONTROL_CYCLE | Idn::COMMUNICATION_CYCLE => Some("`bus.cycle`"),
        Idn::OPERATION_MODE => Some("`mode`"),
        Idn::TELEGRAM_TYPE | Idn::AT_LIST | Idn::MDT_LIST => Some("`mode`, `pdo.rx` and `pdo.tx`"),
        Idn::MASTER_CONTROL_WORD => Some("the cycle"),
        _ => None,
    }
}
