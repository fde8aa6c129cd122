//! Fault scripts: the fault, its time, and the permitted texts of its report (`docs/network.md`,
//! "Fault scripts").

use std::fmt::Write as _;

/// The effect of a fault on a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effect {
    /// The configuration tolerates the fault: the run goes on.
    None,
    /// The run fails if its axes are powered at the time of the fault.
    Failure,
    /// Both results are possible, depending on other events.
    Open,
}

/// A moment of a run without faults.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Moment {
    /// The n-th change of 0x6060.
    ModeChange(usize),
    /// The run begins to stop.
    Stop,
}

#[derive(Debug, Clone)]
pub struct Fault {
    pub kind: &'static str,
    /// Seconds since the first frame; 0: from the start.
    pub at: f64,
    /// The reference of `at`, taken from a run without faults; `None`: the first frame.
    pub after: Option<Moment>,
    pub lasts: Option<f64>,
    /// The keys of this fault kind, as TOML.
    pub keys: Vec<(&'static str, String)>,
    /// Its position, and its name with those of its axes.
    pub device: Option<(u16, Vec<String>)>,
    pub effect: Effect,
}

impl Fault {
    pub fn new(kind: &'static str, at: f64, effect: Effect) -> Self {
        Self {
            kind,
            at,
            after: None,
            lasts: None,
            keys: Vec::new(),
            device: None,
            effect,
        }
    }

    pub fn lasting(mut self, seconds: f64) -> Self {
        self.lasts = Some(seconds);
        self
    }

    pub fn key(mut self, key: &'static str, value: impl std::fmt::Display) -> Self {
        self.keys.push((key, value.to_string()));
        self
    }

    pub fn device(mut self, position: u16, names: Vec<String>) -> Self {
        self.device = Some((position, names));
        self
    }

    fn value(&self, key: &str) -> Option<&str> {
        self.keys
            .iter()
            .find(|of| of.0 == key)
            .map(|of| of.1.as_str())
    }

    /// True if a report may describe this fault: by the name of its cause, or by its headline and
    /// error.
    pub fn explains(&self, report: &Words) -> bool {
        let text = &report.text;
        let named = self
            .device
            .as_ref()
            .is_some_and(|of| of.1.iter().any(|name| text.contains(&format!("`{name}`"))));
        let cause = report.cause.as_str();
        let silence = matches!(cause, "silence" | "nobody-answers")
            || [
                "answer",
                "lost",
                "no frame",
                "process data",
                "silent",
                "too late",
                "timed out",
            ]
            .iter()
            .any(|word| text.contains(word));
        let first = self.device.as_ref().is_some_and(|of| of.0 == 0);
        match self.kind {
            "frame-loss" | "silent" => silence,
            "frame-delay" => cause == "late-frames" || silence,
            "frame-corrupt" => cause == "damaged-frames" || silence,
            "link-break" | "power-off" | "absent" => named || first && silence,
            // A drive in a mode of motion reports RxPDO timeout (docs/drive-motion.md).
            "watchdog" => {
                let words = ["atchdog", "0x8250", "0x8180", "0xf8250"];
                named && (cause == "watchdog" || words.iter().any(|word| text.contains(word)))
            }
            "sync-late" => named && (cause == "sync" || text.contains("ync")),
            "other-main-device" => {
                cause == "other-main-device"
                    || ["MainDevice", "another program"]
                        .iter()
                        .any(|word| text.contains(word))
            }
            "drive-fault" => {
                let code = self.value("code").unwrap_or_default();
                named && (text.contains(code) || text.contains("drive fault"))
            }
            "frame-duplicate" | "emergency" => false,
            "refuse-state" => named && (text.contains("refus") || text.contains("AL status")),
            _ => named,
        }
    }
}

/// True for a property of the simulated drive, which is in the machine file.
fn is_quirk(fault: &Fault) -> bool {
    fault.kind.starts_with("quirk ")
}

/// The relevant texts of a report.
#[derive(Debug, Clone, Default)]
pub struct Words {
    pub text: String,
    /// The kind of cause in the fault report, or empty.
    pub cause: String,
}

/// Formats a script time in ms.
fn ms(seconds: f64) -> String {
    format!("{:.3}ms", seconds * 1e3)
}

/// Returns the script as TOML text.
pub fn script(seed: u64, faults: &[Fault]) -> String {
    let mut text = format!("seed = {}\n", seed % 1_000_000);
    for fault in faults.iter().filter(|fault| !is_quirk(fault)) {
        let _ = write!(text, "\n[[fault]]\nkind = \"{}\"\n", fault.kind);
        if fault.at > 0.0 {
            let _ = writeln!(text, "at = \"{}\"", ms(fault.at));
        }
        if let Some(lasts) = fault.lasts {
            let _ = writeln!(text, "for = \"{}\"", ms(lasts));
        }
        if let Some((position, _)) = &fault.device {
            let _ = writeln!(text, "device = {position}");
        }
        for (key, value) in &fault.keys {
            let _ = writeln!(text, "{key} = {value}");
        }
    }
    text
}
