//! Identification numbers (IEC 61800-7-204): standard (S) or product-specific (P) data, a parameter
//! set and a data block.

use core::fmt;
use core::str::FromStr;

/// An identification number.
///
/// ```
/// use ecaxis_ecat::mailbox::soe::Idn;
///
/// assert_eq!(Idn(0x802f).to_string(), "P-0-0047");
/// assert_eq!("S-0-0047".parse(), Ok(Idn::standard(47)));
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Idn(pub u16);

const PRODUCT: u16 = 0x8000;
const BLOCK: u16 = 0x0fff;

/// A text that is not an IDN.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("not an IDN: write S or P, a parameter set from 0 to 7 and a number up to 4095 (S-0-0047)")]
pub struct IdnError;

impl Idn {
    /// The control unit cycle time in µs.
    pub const CONTROL_CYCLE: Self = Self::standard(1);
    /// The communication cycle time in µs.
    pub const COMMUNICATION_CYCLE: Self = Self::standard(2);
    /// The error bits of class 1.
    pub const CLASS_1_DIAGNOSTIC: Self = Self::standard(11);
    /// The telegram type.
    pub const TELEGRAM_TYPE: Self = Self::standard(15);
    /// The IDNs of the AT, the inputs.
    pub const AT_LIST: Self = Self::standard(16);
    /// The list of all IDNs.
    pub const ALL_IDNS: Self = Self::standard(17);
    /// The IDNs of the MDT, the outputs.
    pub const MDT_LIST: Self = Self::standard(24);
    /// The primary operation mode.
    pub const OPERATION_MODE: Self = Self::standard(32);
    /// The velocity command value.
    pub const VELOCITY_COMMAND: Self = Self::standard(36);
    /// The velocity feedback value.
    pub const VELOCITY_FEEDBACK: Self = Self::standard(40);
    /// The position command value.
    pub const POSITION_COMMAND: Self = Self::standard(47);
    /// The position feedback value of the motor encoder.
    pub const POSITION_FEEDBACK: Self = Self::standard(51);
    /// The torque command value.
    pub const TORQUE_COMMAND: Self = Self::standard(80);
    /// The torque feedback value.
    pub const TORQUE_FEEDBACK: Self = Self::standard(84);
    /// The diagnostic message.
    pub const DIAGNOSTIC_MESSAGE: Self = Self::standard(95);
    /// The procedure command that resets errors of class 1.
    pub const RESET_CLASS_1: Self = Self::standard(99);
    /// The master control word.
    pub const MASTER_CONTROL_WORD: Self = Self::standard(134);
    /// The drive status word.
    pub const DRIVE_STATUS_WORD: Self = Self::standard(135);
    /// The procedure command for homing by the drive.
    pub const HOMING: Self = Self::standard(148);
    /// The diagnostic number.
    pub const DIAGNOSTIC_NUMBER: Self = Self::standard(390);

    /// Returns S-0-`block`; higher bits of `block` are dropped.
    #[must_use]
    pub const fn standard(block: u16) -> Self {
        Self(block & BLOCK)
    }

    /// Returns P-0-`block`; higher bits of `block` are dropped.
    #[must_use]
    pub const fn product(block: u16) -> Self {
        Self(PRODUCT | block & BLOCK)
    }

    /// True for product-specific data (P).
    #[must_use]
    pub const fn is_product(self) -> bool {
        self.0 & PRODUCT != 0
    }

    /// Returns the parameter set, 0 to 7.
    #[must_use]
    pub const fn parameter_set(self) -> u16 {
        self.0 >> 12 & 7
    }

    /// Returns the number of the data block, 0 to 4095.
    #[must_use]
    pub const fn block(self) -> u16 {
        self.0 & BLOCK
    }

    /// Returns the name of a standard IDN. All parameter sets have the same names.
    #[must_use]
    pub fn name(self) -> Option<&'static str> {
        if self.is_product() {
            return None;
        }
        let at = IDN_NAMES.binary_search_by_key(&self.block(), |(block, _)| *block);
        IDN_NAMES.get(at.ok()?).map(|(_, name)| *name)
    }

    /// Returns the IDN with its name: `S-0-0047 (Position command value)`.
    pub fn named(self) -> impl fmt::Display {
        struct Named(Idn);
        impl fmt::Display for Named {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                match self.0.name() {
                    Some(name) => write!(f, "{} ({name})", self.0),
                    None => self.0.fmt(f),
                }
            }
        }
        Named(self)
    }
}

impl fmt::Display for Idn {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = if self.is_product() { 'P' } else { 'S' };
        write!(f, "{kind}-{}-{:04}", self.parameter_set(), self.block())
    }
}

impl FromStr for Idn {
    type Err = IdnError;

    fn from_str(text: &str) -> Result<Self, IdnError> {
        let mut parts = text.split('-');
        let (Some(kind), Some(set), Some(block), None) =
            (parts.next(), parts.next(), parts.next(), parts.next())
        else {
            return Err(IdnError);
        };
        let number = |digits: &str, max: u16| {
            let valid = (1..=4).contains(&digits.len());
            let valid = valid && digits.bytes().all(|byte| byte.is_ascii_digit());
            let number = digits.parse::<u16>().ok().filter(|n| valid && *n <= max);
            number.ok_or(IdnError)
        };
        let kind = match kind {
            "S" | "s" => 0,
            "P" | "p" => PRODUCT,
            _ => return Err(IdnError),
        };
        Ok(Self(kind | number(set, 7)? << 12 | number(block, BLOCK)?))
    }
}

/// The names of standard IDNs, sorted by data block.
pub const IDN_NAMES: &[(u16, &str)] = &[
    (1, "NC cycle time (TNcyc)"),
    (2, "Communication cycle time (TScyc)"),
    (11, "Class 1 diagnostic"),
    (12, "Class 2 diagnostic"),
    (13, "Class 3 diagnostic"),
    (14, "Interface status"),
    (15, "Telegram type"),
    (16, "Configuration list of AT"),
    (17, "IDN list of all operation data"),
    (18, "IDN list of operation data for CP2"),
    (19, "IDN list of operation data for CP3"),
    (21, "IDN list of invalid operation data for CP2"),
    (22, "IDN list of invalid operation data for CP3"),
    (24, "Configuration list of MDT"),
    (25, "IDN list of all procedure commands"),
    (29, "MDT error counter"),
    (30, "Manufacturer version"),
    (32, "Primary operation mode"),
    (33, "Secondary operation mode 1"),
    (34, "Secondary operation mode 2"),
    (35, "Secondary operation mode 3"),
    (36, "Velocity command value"),
    (37, "Additive velocity command value"),
    (38, "Positive velocity limit value"),
    (39, "Negative velocity limit value"),
    (40, "Velocity feedback value 1"),
    (41, "Homing velocity"),
    (42, "Homing acceleration"),
    (43, "Velocity polarity parameter"),
    (44, "Velocity data scaling type"),
    (45, "Velocity data scaling factor"),
    (46, "Velocity data scaling exponent"),
    (47, "Position command value"),
    (49, "Positive position limit value"),
    (50, "Negative position limit value"),
    (51, "Position feedback value 1"),
    (52, "Reference distance 1"),
    (53, "Position feedback value 2"),
    (55, "Position polarity parameter"),
    (57, "Position window"),
    (76, "Position data scaling type"),
    (77, "Linear position data scaling factor"),
    (78, "Linear position data scaling exponent"),
    (79, "Rotational position resolution"),
    (80, "Torque command value"),
    (81, "Additive torque command value"),
    (82, "Positive torque limit value"),
    (83, "Negative torque limit value"),
    (84, "Torque feedback value"),
    (85, "Torque polarity parameter"),
    (86, "Torque/force data scaling type"),
    (91, "Bipolar velocity limit value"),
    (92, "Bipolar torque limit value"),
    (93, "Torque/force data scaling factor"),
    (94, "Torque/force data scaling exponent"),
    (95, "Diagnostic message"),
    (96, "Slave arrangement"),
    (97, "Mask class 2 diagnostic"),
    (98, "Mask class 3 diagnostic"),
    (99, "Reset class 1 diagnostic"),
    (100, "Velocity loop proportional gain"),
    (101, "Velocity loop integral action time"),
    (103, "Modulo value"),
    (104, "Position loop Kv factor"),
    (106, "Current loop proportional gain 1"),
    (107, "Current loop integral action time 1"),
    (109, "Motor peak current"),
    (110, "Amplifier peak current"),
    (111, "Motor continuous stall current"),
    (112, "Amplifier rated current"),
    (113, "Maximum motor speed"),
    (114, "Load limit of the motor"),
    (116, "Resolution of motor feedback"),
    (117, "Resolution of external feedback"),
    (121, "Input revolutions of load gear"),
    (122, "Output revolutions of load gear"),
    (123, "Feed constant"),
    (127, "CP3 transition check"),
    (128, "CP4 transition check"),
    (129, "Manufacturer class 1 diagnostic"),
    (130, "Probe value 1 positive edge"),
    (131, "Probe value 1 negative edge"),
    (134, "Master control word"),
    (135, "Drive status word"),
    (136, "Positive acceleration limit value"),
    (137, "Negative acceleration limit value"),
    (138, "Bipolar acceleration limit value"),
    (140, "Controller type"),
    (141, "Motor type"),
    (142, "Application type"),
    (143, "SYSTEM interface version"),
    (146, "NC-controlled homing"),
    (147, "Homing parameter"),
    (148, "Drive-controlled homing"),
    (150, "Reference offset 1"),
    (159, "Monitoring window"),
    (160, "Acceleration data scaling type"),
    (169, "Probe control"),
    (170, "Probing cycle"),
    (179, "Probe status"),
    (185, "Length of the configurable data record in the AT"),
    (186, "Length of the configurable data record in the MDT"),
    (187, "IDN list of configurable data in the AT"),
    (188, "IDN list of configurable data in the MDT"),
    (189, "Following distance"),
    (192, "IDN list of all backup operation data"),
    (193, "Positioning jerk"),
    (196, "Motor rated current"),
    (201, "Motor warning temperature"),
    (204, "Motor shutdown temperature"),
    (206, "Drive on delay time"),
    (207, "Drive off delay time"),
    (216, "Switch parameter set"),
    (256, "Multiplication 1"),
    (258, "Target position"),
    (259, "Positioning velocity"),
    (260, "Positioning acceleration"),
    (262, "Load defaults"),
    (263, "Load working memory"),
    (264, "Backup working memory"),
    (292, "IDN list of all operation modes"),
    (301, "Allocation of real-time control bit 1"),
    (303, "Allocation of real-time control bit 2"),
    (305, "Allocation of real-time status bit 1"),
    (307, "Allocation of real-time status bit 2"),
    (348, "Acceleration feed-forward gain"),
    (359, "Positioning deceleration"),
    (372, "Drive halt acceleration bipolar"),
    (375, "Diagnostic numbers list"),
    (380, "DC bus voltage"),
    (383, "Motor temperature"),
    (384, "Amplifier temperature"),
    (390, "Diagnostic number"),
    (400, "Home switch"),
    (403, "Position feedback value status"),
    (429, "Emergency stop deceleration"),
];
