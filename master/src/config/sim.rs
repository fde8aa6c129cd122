//! `[device.sim]`: settings of a device on the simulated bus.

use ecaxis_esi as esi;
use ecaxis_esi::{Device, EsiFile};
use ecaxis_sim::gateway::GatewayOptions;
use ecaxis_sim::network::topology::Media;
use ecaxis_sim::{Medium, PortRequest, Quirks, Topology, TopologyError};

use super::fields::KeyExt;
use super::problem::{Problems, Span, suggestion};
use super::raw::{RawDevice, RawSim};
use super::sim_motor::{self, MotorSetup};
use super::sim_quirks;
use super::travel::{self, TrackSetup};
use super::{AxisSetup, DeviceConfig, Locator};

/// Settings of a simulated device that its ESI file does not describe.
#[derive(Debug, Clone, Default)]
pub struct SimSetup {
    /// The name of the upstream device; `None`: according to the device order.
    pub after: Option<String>,
    /// The port of that device.
    pub port: Option<u8>,
    /// The propagation delay on the cable to it, one way.
    pub cable_ns: Option<u64>,
    /// True if the cables at its IN and OUT are swapped.
    pub reversed: bool,
    /// The drift of its clock against true time.
    pub drift_ppm: Option<f64>,
    /// The time of its clock at power-on.
    pub offset_ns: u64,
    /// The maximum deviation of its clock reads in either direction.
    pub jitter_ns: u32,
    /// The time from a request in AL control to the answer in AL status.
    pub state_change_ns: Option<u64>,
    /// The modules in the slots as (place, identity); `None`: those that the device is configured
    /// with.
    pub modules: Option<Vec<(usize, u32)>>,
    /// The network behind a gateway.
    pub gateway: Option<GatewayOptions>,
    /// The switches and ends along a drive's axis.
    pub track: TrackSetup,
    /// The motor of a drive's axis.
    pub motor: MotorSetup,
    /// How the device differs from the standard.
    pub quirks: Quirks,
}

/// The maximum drift. Crystals are far better.
const MOST_DRIFT_PPM: f64 = 1000.0;
/// Checks the settings. `names` are those of all devices; for `axis` see [`travel::check`].
pub(crate) fn check(
    raw: RawSim,
    names: &[String],
    axis: Result<Option<&AxisSetup>, ()>,
    p: &mut Problems<'_>,
) -> SimSetup {
    if let Some(after) = &raw.after
        && !names.contains(after.get_ref())
    {
        let known = names.iter().map(String::as_str);
        let hint = suggestion(after.get_ref(), known, "devices");
        let message = format!("there is no device \"{}\"", after.get_ref());
        p.add_hint(after.span(), message, hint);
    }
    if let (Some(port), None) = (&raw.port, &raw.after) {
        let message = "the device of this port is missing";
        let hint = "add `after`, the name of the device it is connected to";
        p.add_hint(port.span(), message, hint);
    }
    if let Some(drift) = &raw.drift_ppm
        && drift.get_ref().abs() > MOST_DRIFT_PPM
    {
        p.add(
            drift.span(),
            "a clock that is off by more than 1000 ppm is broken",
        );
    }
    SimSetup {
        after: raw.after.as_ref().map(|a| a.get_ref().clone()),
        port: raw.port.value(),
        cable_ns: raw.cable.value(),
        reversed: raw.reversed.value().unwrap_or(false),
        drift_ppm: raw.drift_ppm.value(),
        offset_ns: raw.offset.value().unwrap_or(0),
        jitter_ns: raw
            .jitter
            .value()
            .and_then(|ns| u32::try_from(ns).ok())
            .unwrap_or(0),
        state_change_ns: raw.state_change.value(),
        modules: None,
        gateway: None,
        motor: raw
            .motor
            .map(|raw| sim_motor::check(&raw, axis, p))
            .unwrap_or_default(),
        quirks: raw
            .quirks
            .map(|raw| sim_quirks::check(&raw, axis, p))
            .unwrap_or_default(),
        track: raw
            .track
            .and_then(|raw| travel::check(&raw, axis, p))
            .unwrap_or_default(),
    }
}

/// Returns the modules that the simulated device has in its slots, as (place, identity). `None`
/// without such a key, or if a module does not fit.
pub(crate) fn modules(
    raw: &RawSim,
    (file, device): (&EsiFile, &Device),
    cycle_ns: u64,
    p: &mut Problems<'_>,
) -> Option<Vec<(usize, u32)>> {
    let key = raw.modules.as_ref()?;
    let names: Vec<&str> = key.get_ref().iter().map(String::as_str).collect();
    let choice = esi::SelectOptions {
        modules: Some(&names),
        cycle_ns,
        ..esi::SelectOptions::default()
    };
    match esi::select(file, device, &choice) {
        Ok(selection) => {
            let plugged = selection.modules.iter();
            Some(plugged.map(|m| (m.place, m.ident)).collect())
        }
        Err(error) => {
            p.add(key.span(), error.to_string());
            None
        }
    }
}

/// Returns the devices in the order in which frames pass them. Devices located by alias or
/// identification fill the gaps in file order, each with its segment.
#[must_use]
pub fn bus_order(devices: &[DeviceConfig]) -> Vec<&DeviceConfig> {
    let mut placed: Vec<Option<&DeviceConfig>> = devices.iter().map(|_| None).collect();
    for device in devices {
        if let Locator::Position(position) = device.at
            && let Some(place @ None) = placed.get_mut(usize::from(position))
        {
            *place = Some(device);
        }
    }
    let is_elsewhere = |(_, d): &(usize, &DeviceConfig)| !matches!(d.at, Locator::Position(_));
    let mut others: Vec<_> = devices.iter().enumerate().filter(is_elsewhere).collect();
    others.sort_by_key(|(n, device)| match device.at {
        Locator::Behind(head, place) => {
            let head = devices.iter().position(|d| d.at == head.locator());
            (head.unwrap_or(*n), place)
        }
        _ => (*n, 0),
    });
    let mut others = others.into_iter().map(|(_, device)| device);
    let filled = placed
        .into_iter()
        .map(|place| place.or_else(|| others.next()));
    filled.flatten().collect()
}

/// Returns the cabling of the simulated bus, with the indices of [`bus_order`].
///
/// # Errors
/// Every device that cannot be at its position; [`topology_message`] explains it.
pub fn topology(devices: &[DeviceConfig]) -> Result<Topology, Vec<TopologyError>> {
    let order = bus_order(devices);
    let requests: Vec<Option<PortRequest>> = order
        .iter()
        .map(|device| {
            let name = device.sim.after.as_ref()?;
            Some(PortRequest {
                after: order.iter().position(|d| d.name == *name)?,
                port: device.sim.port,
                shared: device.optional,
            })
        })
        .collect();
    let media = media(&order);
    let mut topology = Topology::connect(&media, &requests)?;
    for (n, device) in order.iter().enumerate() {
        if device.sim.reversed {
            topology = topology.reversed(&media, n).map_err(|error| vec![error])?;
        }
        if let Some(ns) = device.sim.cable_ns {
            topology = topology.with_cable(n, ns);
        }
    }
    Ok(topology)
}

/// Returns the ports of the devices by their ESI files.
pub(crate) fn media(order: &[&DeviceConfig]) -> Vec<Media> {
    let physics = order.iter().map(|d| d.device.physics.as_str());
    physics.map(Medium::from_physics).collect()
}

/// Returns the problem with a device's connection, and a hint.
#[must_use]
pub fn topology_message(error: &TopologyError, devices: &[DeviceConfig]) -> (String, String) {
    use TopologyError as E;
    let order = bus_order(devices);
    let media = media(&order);
    let name = |n: usize| order.get(n).map_or("?", |d| d.name.as_str());
    let medium = |n: usize, port: u8| {
        let medium = media.get(n).and_then(|ports| ports.get(usize::from(port)));
        medium_name(medium.copied().unwrap_or_default())
    };
    let ports = |n: usize| {
        let own = media.get(n).copied().unwrap_or_default();
        let there = (0..).zip(own).filter(|(_, m)| *m != Medium::None);
        let listed: Vec<String> = there
            .map(|(port, m)| format!("{port} ({})", medium_name(m)))
            .collect();
        format!("by its ESI file it has ports {}", listed.join(", "))
    };
    match *error {
        E::NotBefore { device, after } => (
            format!(
                "frames do not reach \"{}\" before \"{}\", so it cannot be connected to it",
                name(after),
                name(device)
            ),
            "positions count in the order in which frames pass the devices".to_owned(),
        ),
        E::Upstream { after, .. } => (
            format!("port 0 of \"{}\" leads to the MainDevice", name(after)),
            ports(after),
        ),
        E::NoSuchPort { after, port, .. } => (
            format!("\"{}\" has no port {port}", name(after)),
            ports(after),
        ),
        E::Taken {
            after, port, by, ..
        } => (
            format!(
                "port {port} of \"{}\" leads to \"{}\"",
                name(after),
                name(by)
            ),
            ports(after),
        ),
        E::OutOfOrder {
            device,
            after,
            port,
            by,
        } => (
            format!(
                "frames pass port {port} of \"{}\" before they reach \"{}\", so \"{}\" comes before it on the bus",
                name(after),
                name(by),
                name(device)
            ),
            "frames leave a device at port 3 first, then 1, then 2; each branch is passed whole"
                .to_owned(),
        ),
        E::OtherMedium {
            device,
            after,
            port,
        } => (
            format!(
                "port {port} of \"{}\" is {}, \"{}\" needs {}",
                name(after),
                medium(after, port),
                name(device),
                medium(device, 0)
            ),
            ports(after),
        ),
        E::NoPortAt { device, after } => (
            format!(
                "\"{}\" has no port left for \"{}\", which needs {}",
                name(after),
                name(device),
                medium(device, 0)
            ),
            ports(after),
        ),
        E::NoPort { device } => (
            format!("no device before \"{}\" has a port left", name(device)),
            "devices are connected in the order of their positions".to_owned(),
        ),
        E::NoSecondPort { device } => (
            format!("\"{}\" has no second port to swap its cables", name(device)),
            ports(device),
        ),
        E::NoPortForRing => (error.to_string(), String::new()),
    }
}

fn medium_name(medium: Medium) -> &'static str {
    match medium {
        Medium::Mii => "Ethernet",
        Medium::Ebus => "E-bus",
        Medium::None => "a port",
    }
}

/// The connections given in the file, with the devices' names.
pub(crate) struct Places(Vec<(String, Span)>);

impl Places {
    pub(crate) fn of(devices: &[RawDevice]) -> Self {
        let place = |device: &RawDevice| {
            let sim = device.sim.as_ref()?;
            let span = sim.port.place().or(sim.after.place())?;
            Some((device.name.as_ref()?.get_ref().clone(), span))
        };
        Self(devices.iter().filter_map(place).collect())
    }

    /// Reports connections that are impossible. A device without a connection in the file is not a
    /// mistake, because the real bus may differ.
    pub(crate) fn check(&self, devices: &[DeviceConfig], p: &mut Problems<'_>) {
        let order = bus_order(devices);
        for error in topology(devices).err().unwrap_or_default() {
            let device = error.device().and_then(|n| order.get(n));
            let asked = self
                .0
                .iter()
                .find(|(name, _)| device.is_some_and(|d| d.name == *name));
            if let Some((_, span)) = asked {
                let (message, hint) = topology_message(&error, devices);
                p.add_hint(span.clone(), message, hint);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use ecaxis_ecat::index::DeviceIndex;
    use ecaxis_sim::Uplink;

    use super::super::{ConfigError, Machine, Problem, parse};
    use super::*;

    const ESI: &str = r##"<?xml version="1.0"?>
<EtherCATInfo><Vendor><Id>#x1</Id><Name>Test</Name></Vendor><Descriptions><Devices>
<Device Physics="YKY"><Type ProductCode="#x1" RevisionNo="#x1">C</Type><Name>Coupler</Name></Device>
<Device Physics="KK"><Type ProductCode="#x2" RevisionNo="#x1">T</Type><Name>Terminal</Name></Device>
<Device Physics="YY"><Type ProductCode="#x3" RevisionNo="#x1">B</Type><Name>Box</Name></Device>
</Devices></Descriptions></EtherCATInfo>
"##;

    /// Loads a bus of devices: name, type, position and the lines of their `[device.sim]`.
    fn load(devices: &[(&str, &str, usize, &str)]) -> Result<Machine, ConfigError> {
        let folder = tempfile::tempdir().expect("folder");
        std::fs::write(folder.path().join("bus.xml"), ESI).expect("file");
        let mut text = "[bus]\ncycle = \"1ms\"\n".to_owned();
        for (name, kind, position, sim) in devices {
            text += &format!("[[device]]\nname = \"{name}\"\nesi = \"bus.xml\"\n");
            text += &format!("type = \"{kind}\"\nposition = {position}\n[device.sim]\n{sim}\n");
        }
        parse(&folder.path().join("m.toml"), &text)
    }

    fn problems(devices: &[(&str, &str, usize, &str)]) -> Vec<Problem> {
        match load(devices) {
            Err(ConfigError::Problems(problems)) => problems,
            other => panic!("expected problems: {other:?}"),
        }
    }

    #[test]
    fn simulated_bus_gets_the_configured_settings() {
        let machine = load(&[
            (
                "c",
                "C",
                0,
                "drift_ppm = -20\noffset = \"3s\"\njitter = \"15ns\"\nstate_change = \"2s\"",
            ),
            ("x", "B", 2, "after = \"c\"\nport = 2\ncable = \"150ns\""),
            ("t", "T", 1, "after = \"c\""),
        ]);
        let machine = machine.expect("good");
        let order: Vec<&str> = bus_order(&machine.devices)
            .iter()
            .map(|d| d.name.as_str())
            .collect();
        assert_eq!(order, ["c", "t", "x"]);
        let coupler = &machine.devices[DeviceIndex(0)].sim;
        assert_eq!(coupler.drift_ppm, Some(-20.0));
        assert_eq!((coupler.offset_ns, coupler.jitter_ns), (3_000_000_000, 15));
        assert_eq!(coupler.state_change_ns, Some(2_000_000_000));
        let bus = topology(&machine.devices).expect("good");
        let at = |device, port| Some(Uplink { device, port });
        assert_eq!([bus.uplink(1), bus.uplink(2)], [at(0, 1), at(0, 2)]);
    }

    #[test]
    #[rustfmt::skip] // one row per mistake
    fn simulated_bus_rejects_wrong_connections() {
        let c = ("c", "C", 0, "");
        for (rest, message, hint) in [
            (&[("t", "T", 1, "after = \"d\"")][..], "no device \"d\"", "devices"),
            (&[("t", "T", 1, "port = 1")], "the device of this port is missing", "add `after`"),
            (&[("t", "T", 1, "after = \"c\"\nport = 0")], "from 1 to 3, found 0", ""),
            (&[("t", "T", 1, "after = \"c\"\nport = 3")], "\"c\" has no port 3", "0 (Ethernet), 1 (E-bus), 2 (Ethernet)"),
            (&[("t", "T", 1, "after = \"c\"\nport = 2")], "port 2 of \"c\" is Ethernet, \"t\" needs E-bus", ""),
            (&[("t", "T", 1, "after = \"t\"")], "frames do not reach \"t\" before \"t\"", "positions count"),
            (&[("t", "T", 1, ""), ("u", "T", 2, "after = \"c\"\nport = 1")], "port 1 of \"c\" leads to \"t\"", ""),
            (&[("x", "B", 1, ""), ("y", "B", 2, "after = \"c\"")], "\"c\" has no port left for \"y\", which needs Ethernet", ""),
            // Frames pass a coupler's terminals before the devices at its second socket.
            (&[("x", "B", 1, ""), ("t", "T", 2, "after = \"c\"")], "frames pass port 1 of \"c\" before they reach \"x\", so \"t\" comes before it", "port 3 first"),
            (&[("x", "B", 1, "drift_ppm = 2000")], "more than 1000 ppm", ""),
            (&[("x", "B", 1, "jitter = \"2ms\"")], "`jitter` of 2 ms is not possible", ""),
            (&[("x", "B", 1, "cable = \"2ms\"")], "`cable` of 2 ms is not possible", ""),
            (&[("x", "B", 1, "drift = 1.0")], "unknown key `drift` in [device.sim]", "`drift_ppm`"),
        ] {
            let mut bus = vec![c];
            bus.extend_from_slice(rest);
            let found = problems(&bus);
            let [problem] = found.as_slice() else { panic!("{rest:?}: {found:#?}") };
            assert!(problem.message.contains(message), "{problem}");
            assert!(problem.hint.as_deref().unwrap_or_default().contains(hint), "{problem}");
        }
    }

    #[test]
    fn simulated_bus_reports_each_wrong_connection_with_its_line() {
        let found = problems(&[
            ("c", "C", 0, ""),
            ("t", "T", 1, "after = \"c\"\nport = 3"),
            ("u", "T", 2, "after = \"c\"\nport = 2"),
        ]);
        let lines: Vec<u32> = found.iter().map(|p| p.line).collect();
        assert_eq!(lines, [17, 25]);
    }
}
