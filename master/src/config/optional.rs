//! Devices that may be absent (`optional`).

use ecaxis_ecat::index::{DeviceIndex, IndexVec};

use toml::Spanned;

use super::problem::{Problems, Span};
use super::raw::RawDevice;
use super::steps::Program;
use super::{DeviceConfig, GroupStopScope, Locator};

/// The keys `optional = true` and `behind` of the file, with the names of their devices.
pub(crate) struct OptionalPlaces(Vec<(String, Span)>);

impl OptionalPlaces {
    pub(crate) fn of(devices: &[RawDevice]) -> Self {
        let place = |device: &RawDevice| {
            let optional = device.optional.as_ref().filter(|key| *key.get_ref());
            let behind = device.behind.as_ref().map(Spanned::span);
            let key = behind.or(optional.map(Spanned::span))?;
            Some((device.name.as_ref()?.get_ref().clone(), key))
        };
        Self(devices.iter().filter_map(place).collect())
    }

    /// Reports optional devices that could not appear during a run.
    pub(crate) fn check(
        &self,
        devices: &IndexVec<DeviceIndex, DeviceConfig>,
        program: &Program,
        p: &mut Problems<'_>,
    ) {
        for (name, span) in &self.0 {
            let found = devices.enumerate().find(|(_, device)| device.name == *name);
            let Some((index, device)) = found else {
                continue;
            };
            let mut groups = program.stop.groups.iter();
            let group = groups.find(|group| group.devices.contains(&index));
            let other = group.and_then(|group| {
                let mut own = group.devices.iter().filter_map(|index| devices.get(*index));
                own.find(|device| !device.optional)
            });
            let steady = |device: &&DeviceConfig| !device.optional && device.selection.dc.is_some();
            let head = match device.at {
                Locator::Behind(head, _) => devices.iter().find(|d| d.at == head.locator()),
                _ => None,
            };
            let (message, hint) = if let Some(head) = head.filter(|head| !head.optional) {
                (
                    format!(
                        "`{}` is always there, so `{name}` has a position",
                        head.name
                    ),
                    format!("write `position`, or `optional = true` for `{}`", head.name),
                )
            } else if matches!(device.at, Locator::Position(_)) {
                (
                    format!("`{name}` may appear at any port, so no position locates it"),
                    "locate it by `alias` or `id`".to_owned(),
                )
            } else if group.is_none_or(|group| group.outside != GroupStopScope::Continue) {
                (
                    format!("the machine stops without `{name}`"),
                    format!(
                        "add a [[stop.group]] with `{} = [\"{name}\"]` and `outside = \"continue\"`",
                        match device.selection.mode {
                            Some(_) => "axes",
                            None => "devices",
                        }
                    ),
                )
            } else if let Some(other) = other {
                (
                    format!(
                        "the group of `{name}` cannot run without it, and `{}` is in it",
                        other.name
                    ),
                    "write a group for optional devices alone".to_owned(),
                )
            } else if device.selection.dc.is_some() && !devices.iter().any(|d| steady(&d)) {
                (
                    format!("`{name}` has SYNC0, and no device that is always there has it"),
                    "write `dc = \"off\"`, or use SYNC0 on a device that is not optional"
                        .to_owned(),
                )
            } else {
                continue;
            };
            p.add_hint(span.clone(), message, hint);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::super::{ConfigError, Locator, Machine, SegmentHead, parse};

    /// Loads drives by name and keys, with a group of all but the first.
    fn load(devices: &[(&str, &str)]) -> Result<Machine, ConfigError> {
        let mut text = "[bus]\ncycle = \"1ms\"\n".to_owned();
        for (name, keys) in devices {
            let limits = "limits = { velocity = 50.0, acceleration = 500.0 }";
            text += &format!(
                "[[device]]\nname = \"{name}\"\nesi = \"esi/EPOS4.xml\"\nmode = \"csp\"\n{keys}\n\
                 [device.axis]\nencoder = 2000\n{limits}\n"
            );
        }
        let names: Vec<_> = devices.iter().skip(1).map(|(name, _)| name).collect();
        text +=
            &format!("[[stop.group]]\nname = \"g\"\naxes = {names:?}\noutside = \"continue\"\n");
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs");
        parse(&folder.join("m.toml"), &text)
    }

    const FIRST: (&str, &str) = ("a", "position = 0");
    const HEAD: (&str, &str) = ("h", "id = 7\noptional = true");

    #[test]
    fn devices_behind_a_head_have_its_places_in_file_order() {
        let devices = [
            FIRST,
            HEAD,
            ("b", "behind = \"h\""),
            ("c", "behind = \"h\""),
        ];
        let machine = load(&devices).expect("good");
        let found: Vec<_> = machine.devices.iter().map(|d| (d.at, d.optional)).collect();
        let behind = |place| (Locator::Behind(SegmentHead::Id(7), place), true);
        assert_eq!(found[2..], [behind(1), behind(2)]);
    }

    #[test]
    #[rustfmt::skip] // one row per mistake
    fn wrong_segments_are_reported() {
        for (keys, head, message, hint) in [
            ("behind = \"q\"", HEAD, "there is no device \"q\"", "`h`"),
            ("behind = \"a\"", HEAD, "has an `alias` or `id`, and `a` has none", "locate the head"),
            ("behind = \"b\"", HEAD, "`b` is not the head of its segment", "behind = \"b\""),
            ("behind = \"h\"\nposition = 1", HEAD, "one of `position`, `alias`, `id` and `behind`", ""),
            ("behind = \"h\"", ("h", "id = 7"), "`h` is always there", "`optional = true` for `h`"),
        ] {
            let problems = match load(&[FIRST, head, ("b", keys)]) {
                Err(ConfigError::Problems(problems)) => problems,
                other => panic!("{keys}: {other:?}"),
            };
            let found = problems.iter().find(|p| p.message.contains(message));
            let found = found.unwrap_or_else(|| panic!("{keys}: {problems:#?}"));
            assert!(found.hint.as_deref().unwrap_or_default().contains(hint), "{found}");
        }
    }
}
