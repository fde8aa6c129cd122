//! Visits each choice that a device offers.

use std::fmt::Write;

use ecaxis_esi::{Device, EsiFile, Finding, SelectOptions, lint, offered_modes, select};

use super::text::{self, digest};

/// A typical bus cycle.
const CYCLE_NS: u64 = 1_000_000;
const MANY_FINDINGS: usize = 24;

pub fn of_file(file: &EsiFile, full: bool) -> String {
    let mut out = format!(
        "vendor {:08x}, {} devices, {} modules\n",
        file.vendors.last().map_or(0, |vendor| vendor.id),
        file.devices.len(),
        file.modules.len()
    );
    findings(&mut out, &lint(file));
    for device in &file.devices {
        out.push_str(&of_device(file, device, full));
    }
    out
}

fn findings(out: &mut String, all: &[Finding]) {
    let lines: Vec<String> = all
        .iter()
        .map(|f| format!("{} {} {}", f.severity, f.position, f.path))
        .collect();
    if lines.len() > MANY_FINDINGS {
        let errors = lines
            .iter()
            .filter(|line| line.starts_with("error"))
            .count();
        let _ = writeln!(
            out,
            "findings {}, errors {errors}, {}",
            lines.len(),
            digest(&lines)
        );
    } else {
        for line in lines {
            let _ = writeln!(out, "{line}");
        }
    }
}

/// The results so far. Equal results are referenced, not repeated.
struct Choices<'a> {
    file: &'a EsiFile,
    device: &'a Device,
    full: bool,
    out: String,
    seen: Vec<(String, Vec<String>)>,
}

fn of_device(file: &EsiFile, device: &Device, full: bool) -> String {
    let mut choices = Choices {
        file,
        device,
        full,
        out: text::device(device),
        seen: Vec::new(),
    };
    let plain = SelectOptions {
        cycle_ns: CYCLE_NS,
        ..SelectOptions::default()
    };
    choices.add("default", &plain, full);
    for mode in offered_modes(file, device) {
        choices.add(
            &format!("mode {mode}"),
            &SelectOptions {
                mode: Some(mode),
                ..plain
            },
            full,
        );
    }
    choices.modules(&plain);
    for (n, mapping) in device.sm_mappings.iter().enumerate() {
        let choice = SelectOptions {
            assignment: Some(&mapping.name),
            ..plain
        };
        choices.add(&format!("assignment {}", n + 1), &choice, full);
    }
    for (n, mode) in device.dc_modes.iter().enumerate() {
        // Some files give several OpModes the same name; their descriptions differ.
        let mut before = device.dc_modes.iter().take(n);
        let name = match before.any(|other| other.name == mode.name) {
            true => &mode.description,
            false => &mode.name,
        };
        let choice = SelectOptions {
            dc_mode: Some(name),
            ..plain
        };
        choices.add(&format!("opmode {}", n + 1), &choice, full);
    }
    choices.out
}

impl Choices<'_> {
    /// Visits each module in each place that accepts it, with the other places as empty as
    /// possible. Then visits one choice with all places filled with their first module.
    fn modules(&mut self, plain: &SelectOptions<'_>) {
        let Some(slots) = &self.device.slots else {
            return;
        };
        let mut places: Vec<(bool, Vec<String>)> = Vec::new();
        for slot in &slots.slots {
            let classed = self.file.modules.iter().filter(|module| {
                let class = module.class.as_ref();
                class.is_some_and(|class| slot.module_classes.contains(class))
            });
            let named = slot.module_idents.iter().map(|(ident, _)| *ident);
            let idents: Vec<String> = named
                .chain(classed.map(|module| module.ident))
                .map(|ident| format!("0x{ident:08x}"))
                .collect();
            for instance in 0..slot.max_instances.max(slot.min_instances).clamp(1, 16) {
                places.push((instance < slot.min_instances, idents.clone()));
            }
        }
        let first = |place: &(bool, Vec<String>)| place.1.first().cloned().unwrap_or_default();
        for (number, (_, idents)) in places.iter().enumerate() {
            for ident in idents {
                let modules: Vec<String> = places
                    .iter()
                    .enumerate()
                    .map(|(other, place)| match place {
                        _ if other == number => ident.clone(),
                        (true, _) => first(place),
                        (false, _) => "-".to_owned(),
                    })
                    .collect();
                let name = format!("module {} place {number}", &ident[2..]);
                self.add_modules(&name, &modules, plain, number == 0);
            }
        }
        if places.len() > 1 {
            let modules: Vec<String> = places.iter().map(first).collect();
            self.add_modules("every place", &modules, plain, true);
        }
    }

    fn add_modules(
        &mut self,
        name: &str,
        modules: &[String],
        plain: &SelectOptions<'_>,
        full: bool,
    ) {
        let modules: Vec<&str> = modules.iter().map(String::as_str).collect();
        let choice = SelectOptions {
            modules: Some(&modules),
            ..*plain
        };
        self.add(name, &choice, full && self.full);
    }

    fn add(&mut self, name: &str, choice: &SelectOptions<'_>, full: bool) {
        let selection = match select(self.file, self.device, choice) {
            Ok(selection) => selection,
            Err(error) => {
                let _ = writeln!(self.out, "  {name}: {}", text::error(&error));
                return;
            }
        };
        let dc = text::dc(&selection);
        let lines = text::selection(&selection);
        if let Some((same, _)) = self.seen.iter().find(|(_, known)| *known == lines) {
            let _ = writeln!(self.out, "  {name}: as {same}{dc}");
            return;
        }
        if full {
            let _ = writeln!(self.out, "  {name}:{dc}");
            for line in &lines {
                let _ = writeln!(self.out, "    {line}");
            }
        } else {
            let short = text::short(&selection);
            let _ = writeln!(self.out, "  {name}:{dc} {short} {}", digest(&lines));
        }
        self.seen.push((name.to_owned(), lines));
    }
}
