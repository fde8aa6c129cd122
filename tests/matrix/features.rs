//! The kinds of motion and outputs: a machine and a program for each. The feature's axes form the
//! group `cell` with the idle axis `b`. The axis `w` moves in a group of its own, and the terminal
//! `io` has the inputs for hold and emergency.

use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::machines::with_load_encoder;

use super::drive::Codec;

/// The places of the devices that every machine has.
pub const IO: usize = 0;
pub const WITNESS: usize = 1;
pub const BUDDY: usize = 2;
/// The first device of the feature.
const FIRST: usize = 3;

/// The data of the terminal `io`: input 1 holds, input 2 is an emergency.
pub const HOLD: u8 = 1;
pub const EMERGENCY: u8 = 2;

const SV1_OUTPUTS: &[u16] = &[0x6040, 0x607a, 0x60ff, 0x6071];
const SV1_INPUTS: &[u16] = &[0x6041, 0x6064, 0x606c, 0x6077, 0x6061];
const COUNTS: f64 = 131_072.0;
/// 1024 counts a cycle.
const VELOCITY: f64 = 7.8125;
const ACCELERATION: f64 = 78.125;
const JERK: f64 = 3906.25;
/// 512 and 768 counts a cycle.
const SLOW: f64 = 3.90625;
const FAST: f64 = 5.859_375;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// An axis of the feature.
    Feature,
    /// The other half of a gantry with the first axis.
    Half,
    /// The idle axis in the group of the feature.
    Buddy,
    /// The moving axis of the other group.
    Witness,
}

/// Who makes the set-points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Profile {
    /// The MainDevice: a position in every cycle.
    Positions,
    /// The drive, from a goal.
    Goals,
}

#[derive(Debug, Clone)]
pub struct Axis {
    pub name: String,
    pub device: usize,
    pub codec: Codec,
    pub role: Role,
    pub profile: Profile,
    /// Counts per unit.
    pub counts: f64,
    /// Limits of the file, in units.
    pub velocity: f64,
    pub acceleration: f64,
    pub jerk: f64,
    /// Cycles from one set-point to the next.
    pub steps: usize,
}

impl Axis {
    /// Returns the time in seconds from the highest velocity to rest.
    pub fn ramp_s(&self) -> f64 {
        self.velocity / self.acceleration + self.acceleration / self.jerk
    }
}

/// What must hold between the set-points of the feature's axes, in counts, while it moves.
pub type Relation = fn(&[i32]) -> Result<(), String>;

#[derive(Debug, Clone)]
pub struct Feature {
    pub name: &'static str,
    pub axes: Vec<Axis>,
    /// `[[device]]` tables of the feature, and other tables.
    devices: String,
    tables: String,
    steps: String,
    /// More devices of the group of the witness.
    others: &'static str,
    bus: &'static str,
    /// The number of SubDevices.
    pub devices_total: usize,
    /// The device that is lost. It is the last one: those behind it would be lost too.
    pub lost: usize,
    /// The lost device is in the group of the witness, and comes back.
    pub lost_elsewhere: bool,
    /// A step of the program lasts as long as the motion. It fails with its axes.
    pub blocking: bool,
    /// It ends at a position of the program.
    pub ends_at_target: bool,
    pub relation: Option<Relation>,
    /// The terminal with the output at positions, and its ranges in counts: period, from, to.
    pub output: Option<(usize, [i32; 3])>,
    /// A stream of set-points comes from another machine.
    pub shaft: bool,
    /// The node behind a gateway.
    pub node: Option<u8>,
}

fn axis(name: &str, device: usize, role: Role) -> Axis {
    Axis {
        name: name.to_owned(),
        device,
        codec: Codec::Objects {
            outputs: SV1_OUTPUTS,
            inputs: SV1_INPUTS,
        },
        role,
        profile: Profile::Positions,
        counts: COUNTS,
        velocity: VELOCITY,
        acceleration: ACCELERATION,
        jerk: JERK,
        steps: 1,
    }
}

fn limits(axis: &Axis, more: &str) -> String {
    let (velocity, acceleration, jerk) = (axis.velocity, axis.acceleration, axis.jerk);
    format!(
        "encoder = {}\nlimits = {{ velocity = {velocity:?}, acceleration = {acceleration:?}, jerk = {jerk:?}{more} }}\n",
        axis.counts
    )
}

fn sv1(axis: &Axis) -> String {
    format!(
        "[[device]]\nname = \"{}\"\nesi = \"esi/SV1.xml\"\nposition = {}\nmode = \"csp\"\n[device.axis]\n{}",
        axis.name,
        axis.device,
        limits(axis, ", torque = 100.0, following_error = 2.0")
    )
}

fn epos4(axis: &Axis, esi: &str, mode: &str, more: &str) -> String {
    let Codec::Objects { outputs, inputs } = axis.codec else {
        unreachable!("an EtherCAT drive");
    };
    let list = |objects: &[u16]| {
        let name = |object: &u16| match object {
            0x60e4 => "\"0x60E4:01\"".to_owned(),
            _ => format!("\"0x{object:04X}\""),
        };
        objects.iter().map(name).collect::<Vec<_>>().join(", ")
    };
    format!(
        "[[device]]\nname = \"{}\"\nesi = \"esi/{esi}.xml\"\nposition = {}\nmode = \"{mode}\"\npdo.rx = [{}]\n\
         pdo.tx = [{}]\n[device.axis]\n{}{more}",
        axis.name,
        axis.device,
        list(outputs),
        list(inputs),
        limits(axis, ", torque = 100.0, following_error = 2.0")
    )
}

impl Feature {
    /// Returns a feature of SV1 drives in CSP.
    fn csp(name: &'static str, names: &[&str], steps: &str) -> Self {
        let axes = (FIRST..).zip(names);
        let axes: Vec<Axis> = axes
            .map(|(at, name)| axis(name, at, Role::Feature))
            .collect();
        let devices = axes.iter().map(sv1).collect();
        Self::new(name, axes, devices, steps)
    }

    fn new(name: &'static str, axes: Vec<Axis>, devices: String, steps: &str) -> Self {
        let last = axes.iter().map(|axis| axis.device).max().unwrap_or(FIRST);
        Self {
            name,
            axes,
            devices,
            tables: String::new(),
            steps: steps.to_owned(),
            others: "",
            bus: "",
            devices_total: last + 1,
            lost: last,
            lost_elsewhere: false,
            blocking: false,
            ends_at_target: false,
            relation: None,
            output: None,
            shaft: false,
            node: None,
        }
    }

    /// Returns a feature of one EPOS4 with these objects and 2000 counts per turn.
    fn epos4(
        name: &'static str,
        (esi, mode, profile): (&str, &str, Profile),
        (outputs, inputs): (&'static [u16], &'static [u16]),
        more: &str,
        steps: &str,
    ) -> Self {
        let axis = Axis {
            codec: Codec::Objects { outputs, inputs },
            profile,
            counts: 2000.0,
            velocity: 20.0,
            acceleration: 200.0,
            jerk: 10_000.0,
            ..axis("x", FIRST, Role::Feature)
        };
        let devices = epos4(&axis, esi, mode, more);
        Self::new(name, vec![axis], devices, steps)
    }

    /// True if a step of the program lasts at this moment. At the first one, it waits for the
    /// velocity, except for that of a shaft.
    pub fn is_blocked(&self, moment: usize) -> bool {
        self.blocking || moment == 0 && !self.shaft
    }

    /// Returns the machine file with keys of `[bus]` and the last steps of the program.
    pub fn text(&self, bus: &str, last: &str) -> String {
        let names: Vec<String> = { self.axes.iter() }
            .map(|axis| format!("\"{}\"", axis.name))
            .collect();
        let others = [
            axis("w", WITNESS, Role::Witness),
            axis("b", BUDDY, Role::Buddy),
        ];
        let [witness, buddy] = others.each_ref().map(sv1);
        format!(
            "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n{bus}{}[signals]\nheld = \"io.Input 1\"\npressed = \"io.Input 2\"\n\
             [override]\nhold = {{ held = true }}\n[stop]\nemergency = {{ pressed = true }}\n\
             [[stop.group]]\nname = \"cell\"\naxes = [{}, \"b\"]\noutside = \"continue\"\n\
             [[stop.group]]\nname = \"other\"\naxes = [\"w\"]\n{}outside = \"continue\"\n\
             [[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 0\n{witness}{buddy}{}{}\
             [[step]]\nenable = true\n[[step]]\nvelocity = {{ w = {SLOW:?} }}\n{}{last}",
            self.bus,
            names.join(", "),
            self.others,
            self.devices,
            self.tables,
            self.steps,
        )
    }

    pub fn is_gantry(&self) -> bool {
        self.axes.iter().any(|axis| axis.role == Role::Half)
    }

    /// Returns all axes, with those that every machine has.
    pub fn all_axes(&self) -> Vec<Axis> {
        let mut axes = self.axes.clone();
        axes.push(axis("b", BUDDY, Role::Buddy));
        axes.push(axis("w", WITNESS, Role::Witness));
        axes
    }
}

/// Writes the files that the machines name.
pub fn files() -> Bench {
    let bench = Bench::new();
    bench.change("esi/EPOS4.xml", with_load_encoder);
    bench.write(
        "table.csv",
        "0, 0, 0\n0.5, 0.9765625, 3.90625\n1.5, 4.8828125, 3.90625\n2.0, 5.859375, 0\n",
    );
    bench
}

/// Checks that two targets are a product, both rounded to counts.
fn product(driven: i32, ratio: f64, leader: i32) -> Result<(), String> {
    let exact = f64::from(leader) * ratio;
    let error = (f64::from(driven) - exact).abs();
    let most = 0.5 + 0.5 * ratio.abs() + 1e-6;
    if error > most {
        return Err(format!("{driven}, not {exact:.1}: {error:.1} counts"));
    }
    Ok(())
}

/// The law 3-4-5 (VDI 2143) up and down, 2 turns within 8 turns of the leader.
fn cam(targets: &[i32]) -> Result<(), String> {
    let x = (f64::from(targets[0]) / COUNTS).rem_euclid(8.0) / 4.0;
    let z = x.min(2.0 - x);
    let exact = 2.0 * z * z * z * (10.0 + z * (-15.0 + 6.0 * z)) * COUNTS;
    let error = (f64::from(targets[1]) - exact).abs();
    if error > 1.0 {
        return Err(format!("{} on the cam, not {exact:.1}", targets[1]));
    }
    Ok(())
}

/// Checks that a point is within the tolerance of the square.
fn outline(targets: &[i32]) -> Result<(), String> {
    let [x, y] = [0, 1].map(|n| f64::from(targets[n]) / COUNTS);
    let inside = (3.0 - x).min(3.0 - y).min(x).min(y);
    // A corner is at most the tolerance away, a side never.
    let most = 0.05 + 1.0 / COUNTS;
    if !(-most..=most).contains(&inside) {
        return Err(format!(
            "({x:.4}, {y:.4}) is {inside:.4} turns off the path"
        ));
    }
    Ok(())
}

fn gear_step(cam: &str) -> String {
    format!(
        "[[step]]\ngear = {{ y = {{ to = \"x\", {cam} }} }}\n[[step]]\nvelocity = {{ x = {FAST:?} }}\n\
         [[step]]\ndwell = \"1500ms\"\n"
    )
}

const PROBE: (&[u16], &[u16]) = (
    &[0x6040, 0x607a, 0x60b8],
    &[0x6041, 0x6064, 0x606c, 0x60b9, 0x60ba],
);

/// Every feature of the matrix.
pub fn all() -> Vec<Feature> {
    let turn = format!("[[step]]\nvelocity = {{ x = {SLOW:?} }}\n[[step]]\ndwell = \"1500ms\"\n");
    let mut gantry = Feature::csp("gantry", &["x", "y"], &turn);
    gantry.axes[1].role = Role::Half;
    let mut switched = Feature::csp("position output", &["x"], &turn);
    let terminal = FIRST + 1;
    switched.devices +=
        &format!("[[device]]\nname = \"t\"\nesi = \"esi/IO8.xml\"\nposition = {terminal}\n");
    let period = COUNTS as i32;
    // Two channels of one device.
    let channel = |name, outputs, inputs| Axis {
        codec: Codec::Sercos { outputs, inputs },
        counts: 65_536.0,
        ..axis(name, FIRST, Role::Feature)
    };
    let channels = vec![channel("x", 0, 0), channel("y", 6, 10)];
    let sercos = { channels.iter() }
        .map(|axis| {
            let limits = limits(axis, ", following_error = 2.0");
            format!(
                "[[device.axis]]\nname = \"{}\"\nvelocity_unit = \"mrpm\"\n{limits}",
                axis.name
            )
        })
        .collect::<String>();
    let node = Axis {
        codec: Codec::Node {
            outputs: 2,
            inputs: 2,
        },
        counts: 2000.0,
        velocity: 10.0,
        acceleration: 50.0,
        jerk: 2500.0,
        steps: 4,
        ..axis("x", FIRST, Role::Feature)
    };
    let node_limits = limits(&node, ", following_error = 2.0");
    vec![
        Feature {
            ends_at_target: true,
            blocking: true,
            relation: Some(|targets| product(targets[1], -0.5, targets[0])),
            ..Feature::csp(
                "line",
                &["x", "y"],
                "[[step]]\nline = { x = 10.0, y = -5.0 }\nspeed = 0.75\n",
            )
        },
        Feature {
            // The leader is the last device, which is lost.
            relation: Some(|targets| product(targets[0], -0.5, targets[1])),
            ..Feature::csp("gear", &["y", "x"], &gear_step("ratio = -0.5, offset = 0.0"))
        },
        Feature {
            relation: Some(cam),
            tables: "[[cam]]\nname = \"c\"\npoints = [[0.0, 0.0], [4.0, 2.0], [8.0, 0.0]]\nrepeat = true\n".to_owned(),
            ..Feature::csp("cam", &["x", "y"], &gear_step("cam = \"c\", offset = 0.0"))
        },
        Feature {
            blocking: true,
            ..Feature::csp(
                "superimpose",
                &["x"],
                &format!(
                    "[[step]]\nvelocity = {{ x = {SLOW:?} }}\n[[step]]\nsuperimpose = {{ x = 3.0 }}\n\
                     [[step]]\ndwell = \"600ms\"\n"
                ),
            )
        },
        Feature {
            shaft: true,
            relation: Some(|targets| product(targets[1], -0.5, targets[0])),
            tables: format!(
                "[[line_shaft]]\nname = \"shaft\"\nvelocity = {VELOCITY:?}\nacceleration = {ACCELERATION:?}\n"
            ),
            ..Feature::csp(
                "line shaft",
                &["x", "y"],
                "[[step]]\ndwell = \"5s\"\n\
                 [[step]]\ngear = { x = { to = \"shaft\", ratio = 0.8, offset = 0.0 } }\n\
                 [[step]]\ngear = { y = { to = \"shaft\", ratio = -0.4, offset = 0.0 } }\n\
                 [[step]]\ndwell = \"2500ms\"\n",
            )
        },
        Feature {
            ends_at_target: true,
            blocking: true,
            relation: Some(outline),
            tables: "[[path]]\nname = \"p\"\naxes = [\"x\", \"y\"]\ntolerance = 0.05\nvelocity = 5.0\n\
                     points = [[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [0.0, 3.0], [0.0, 0.0]]\n"
                .to_owned(),
            ..Feature::csp("path", &["x", "y"], "[[step]]\npath = \"p\"\n")
        },
        Feature {
            ends_at_target: true,
            blocking: true,
            ..Feature::csp("table", &["x"], "[[step]]\ntable = { x = \"table.csv\" }\n")
        },
        Feature {
            relation: Some(|targets| product(targets[1], 1.0, targets[0])),
            tables: "[[gantry]]\naxes = [\"x\", \"y\"]\nmax_skew = 0.5\n".to_owned(),
            ..gantry
        },
        Feature {
            tables: "[[position_output]]\noutput = \"t.Output 1\"\naxis = \"x\"\nperiod = 1.0\nranges = [[0.25, 0.75]]\n"
                .to_owned(),
            // The terminal is lost with another group: its axis goes on.
            others: "devices = [\"t\"]\n",
            devices_total: terminal + 1,
            lost: terminal,
            lost_elsewhere: true,
            output: Some((terminal, [period, period / 4, period / 4 * 3])),
            ..switched
        },
        Feature::epos4(
            "second encoder",
            ("EPOS4", "csp", Profile::Positions),
            (
                &[0x6040, 0x607a],
                &[0x6041, 0x6064, 0x606c, 0x60e4],
            ),
            "absolute = true\nsecond_encoder = { input = \"x.0x60E4:01\", counts_per_unit = 2000.0, max_difference = 0.1, offset = 0.0 }\n",
            "[[step]]\nvelocity = { x = 10.0 }\n[[step]]\ndwell = \"1500ms\"\n",
        ),
        Feature {
            blocking: true,
            ..Feature::epos4(
                "probe",
                ("EPOS4", "csp", Profile::Positions),
                PROBE,
                "[device.sim]\ntrack = { probe1 = [15.0, 17.0] }\n",
                "[[step]]\nprobe = { x = { to = 30.0 } }\nspeed = 0.5\n",
            )
        },
        Feature {
            ends_at_target: true,
            blocking: true,
            ..Feature::epos4(
                "PP",
                ("EPOS4", "pp", Profile::Goals),
                (
                    &[0x6040, 0x607a, 0x6081, 0x6083, 0x6084],
                    &[0x6041, 0x6064, 0x606c],
                ),
                "",
                "[[step]]\nmove = { x = 15.0 }\nspeed = 0.5\n",
            )
        },
        Feature::epos4(
            "PV",
            ("EPOS4", "pv", Profile::Goals),
            (
                &[0x6040, 0x60ff, 0x6083, 0x6084],
                &[0x6041, 0x6064, 0x606c],
            ),
            "",
            "[[step]]\nvelocity = { x = 10.0 }\n[[step]]\ndwell = \"1500ms\"\n",
        ),
        Feature {
            node: Some(1),
            ..Feature::new(
                "gateway axis",
                vec![node],
                format!(
                    "[[device]]\nname = \"g\"\nesi = \"esi/gateway.xml\"\ntype = \"GW64\"\nposition = {FIRST}\n\
                     [device.can]\nsync = \"4ms\"\n[[device.node]]\nid = 1\ndrive = \"EPOS 24/1\"\n\
                     outputs = [{{ pdo = 1, at = 2, objects = [\"0x6040\", \"0x2062\"] }}, {{ pdo = 3, at = 8 }}]\n\
                     inputs = [{{ pdo = 1, at = 2, objects = [\"0x6041\", \"0x6064\"] }}, {{ pdo = 3, at = 8 }}]\n\
                     [device.node.axis]\nname = \"x\"\n{node_limits}"
                ),
                "[[step]]\nvelocity = { x = 5.0 }\n[[step]]\ndwell = \"1500ms\"\n",
            )
        },
        Feature::new(
            "Sercos",
            channels,
            format!(
                "[[device]]\nname = \"s\"\nesi = \"esi/SC2.xml\"\nposition = {FIRST}\nmode = \"csp\"\n{sercos}"
            ),
            &format!(
                "[[step]]\nvelocity = {{ x = {SLOW:?}, y = {:?} }}\n[[step]]\ndwell = \"1500ms\"\n",
                -FAST
            ),
        ),
    ]
}
