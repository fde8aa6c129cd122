//! Message definitions in the format `ros2msg`: the message, then each message that it contains.

use std::borrow::Cow;

/// A message type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Schema {
    pub name: &'static str,
    pub text: Cow<'static, str>,
}

macro_rules! with_header {
    ($($part:expr),*) => {
        concat!(
            $($part,)*
            "================================================================================\n",
            "MSG: std_msgs/Header\n",
            "builtin_interfaces/Time stamp\n",
            "string frame_id\n",
            "================================================================================\n",
            "MSG: builtin_interfaces/Time\n",
            "int32 sec\n",
            "uint32 nanosec\n",
        )
    };
}

/// `sensor_msgs/msg/JointState`.
pub const JOINT_STATE: Schema = Schema {
    name: "sensor_msgs/msg/JointState",
    text: Cow::Borrowed(with_header!(
        "std_msgs/Header header\n",
        "string[] name\n",
        "float64[] position\n",
        "float64[] velocity\n",
        "float64[] effort\n"
    )),
};

/// `diagnostic_msgs/msg/DiagnosticArray`.
pub const DIAGNOSTIC_ARRAY: Schema = Schema {
    name: "diagnostic_msgs/msg/DiagnosticArray",
    text: Cow::Borrowed(with_header!(
        "std_msgs/Header header\n",
        "diagnostic_msgs/DiagnosticStatus[] status\n",
        "================================================================================\n",
        "MSG: diagnostic_msgs/DiagnosticStatus\n",
        "byte OK=0\n",
        "byte WARN=1\n",
        "byte ERROR=2\n",
        "byte STALE=3\n",
        "byte level\n",
        "string name\n",
        "string message\n",
        "string hardware_id\n",
        "diagnostic_msgs/KeyValue[] values\n",
        "================================================================================\n",
        "MSG: diagnostic_msgs/KeyValue\n",
        "string key\n",
        "string value\n"
    )),
};

/// `ecaxis_msgs/msg/Axis`: one axis in one cycle.
pub const AXIS: Schema = Schema {
    name: "ecaxis_msgs/msg/Axis",
    text: Cow::Borrowed(with_header!(
        "# One axis in one cycle, in the units of the machine file. NaN: no value.\n",
        "# frame_id is the name of the axis.\n",
        "std_msgs/Header header\n",
        "# The number of the cycle's samples, as in ecaxis_msgs/Bus.\n",
        "uint64 row\n",
        "float64 position\n",
        "float64 velocity\n",
        "# Percent of the rated torque.\n",
        "float64 torque\n",
        "float64 target_position\n",
        "float64 target_velocity\n",
        "float64 target_torque\n",
        "float64 following_error\n",
        "# The position minus that of the second encoder.\n",
        "float64 encoder_difference\n",
        "uint16 statusword\n",
        "uint16 controlword\n",
        "# Modes of operation (0x6060).\n",
        "int8 mode\n",
        "# The state of CiA 402, from the Statusword.\n",
        "uint8 NOT_READY_TO_SWITCH_ON=0\n",
        "uint8 SWITCH_ON_DISABLED=1\n",
        "uint8 READY_TO_SWITCH_ON=2\n",
        "uint8 SWITCHED_ON=3\n",
        "uint8 OPERATION_ENABLED=4\n",
        "uint8 QUICK_STOP_ACTIVE=5\n",
        "uint8 FAULT_REACTION_ACTIVE=6\n",
        "uint8 FAULT=7\n",
        "uint8 UNKNOWN=255\n",
        "uint8 state\n"
    )),
};

/// `ecaxis_msgs/msg/Bus`: one cycle of the bus.
pub const BUS: Schema = Schema {
    name: "ecaxis_msgs/msg/Bus",
    text: Cow::Borrowed(with_header!(
        "# One cycle of the bus. NaN: no value in this cycle.\n",
        "std_msgs/Header header\n",
        "# The number of the cycle's samples since the start.\n",
        "uint64 row\n",
        "# Cycles before this one that were lost on the way.\n",
        "uint64 missed\n",
        "# The number of the cycle since the bus came up.\n",
        "uint64 cycle\n",
        "bool inputs_fresh\n",
        "bool in_op\n",
        "bool stopping\n",
        "bool phase_locked\n",
        "# Seconds.\n",
        "float64 wake_up\n",
        "float64 exchange\n",
        "float64 phase_error\n",
        "float64 work\n"
    )),
};

/// Returns `ecaxis_msgs/msg/Inputs` of a machine: a field for each input.
#[must_use]
pub fn inputs(names: &[String]) -> Schema {
    let mut text = String::from("# The inputs in one cycle.\nstd_msgs/Header header\n");
    let mut fields = vec!["header".to_owned()];
    for name in names {
        let field = unique(&field(name), &fields);
        // A line of its own for the name, whatever its characters.
        let name: String = name.chars().filter(|c| !c.is_control()).collect();
        text += &format!("# {name}\nfloat64 {field}\n");
        fields.push(field);
    }
    Schema {
        name: "ecaxis_msgs/msg/Inputs",
        text: Cow::Owned(text + with_header!()),
    }
}

/// Returns a name as a field, which has lower-case letters, digits and single `_`.
fn field(name: &str) -> String {
    let plain = |c: char| {
        if c.is_ascii_alphanumeric() {
            c.to_ascii_lowercase()
        } else {
            '_'
        }
    };
    let plain: String = name.chars().map(plain).collect();
    let words: Vec<_> = plain.split('_').filter(|word| !word.is_empty()).collect();
    let field = words.join("_");
    match field.starts_with(|c: char| c.is_ascii_alphabetic()) {
        true => field,
        false => format!("input_{field}").trim_end_matches('_').to_owned(),
    }
}

/// Returns the name, with a number if it is in use.
pub(super) fn unique<T: AsRef<str>>(name: &str, used: &[T]) -> String {
    let is_used = |name: &str| used.iter().any(|used| used.as_ref() == name);
    let numbered = (2_u64..).map(|n| format!("{name}_{n}"));
    let mut names = std::iter::once(name.to_owned()).chain(numbered);
    names.find(|name| !is_used(name)).unwrap_or_default()
}
