//! The init commands of one SubDevice, in the order of its transitions.

use ecaxis_ecat::registers;
use ecaxis_ecat::sii::control;
use ecaxis_master::bringup::process_data::{ControlBytes, ProcessDataPlan, RegisterBlock};
use ecaxis_master::bringup::{mailbox_registers, pulse_registers, watchdog_registers};
use ecaxis_master::config::{Bus, StateTimeouts};
use ecaxis_master::esi_library::RevisionMatch;
use ecaxis_master::report::Cause;
use ecaxis_master::rt::image::ImagePlan;

use super::super::command::{EcatCommand, code};
use super::super::xml::Element;
use super::device::ALIAS;
use super::{Network, PlacedDevice, alias};

/// The registers of a controller without `FMMU` count in its ESI.
const MAX_FMMUS: usize = 16;
/// The bytes of all FMMUs and of all SyncManagers.
const FMMUS_LEN: u32 = 256;
const SYNC_MANAGERS_LEN: u32 = 128;
const FMMU_LEN: usize = 16;

/// Requests of AL control, and the states of AL status.
const INIT: u8 = 0x01;
const PRE_OP: u8 = 0x02;
const BOOTSTRAP: u8 = 0x03;
const SAFE_OP: u8 = 0x04;
const OP: u8 = 0x08;
const ACKNOWLEDGE: u8 = 0x10;
const STATE: u8 = 0x0f;
const STATE_AND_ERROR: u8 = 0x1f;

/// How long an EEPROM may read one double word.
const EEPROM_TIMEOUT_MS: u32 = 100;

const TO_INIT: &[&str] = &["PI", "BI", "SI", "OI"];
const UP_TO_PRE_OP: &[&str] = &["IP"];
const LEAVE_INIT: &[&str] = &["IP", "IB"];
const BACK_TO_PRE_OP: &[&str] = &["SP", "OP"];
const WITHOUT_PROCESS_DATA: &[&str] = &["SP", "SI", "OP", "OI"];
const LEAVE_OP: &[&str] = &["OS", "OP", "OI"];

impl PlacedDevice<'_> {
    /// Returns the datagrams of bring-up, and those of the way back.
    pub(super) fn init_commands(
        &self,
        bus: &Bus,
        image: &ImagePlan,
    ) -> Result<Vec<EcatCommand>, Cause> {
        let region = image.regions.get(self.index).copied().flatten();
        // A MainDevice that polls the mailboxes needs no status in the process image.
        let plan = ProcessDataPlan::new(self.config, ControlBytes::Watched, region, None);
        let info = &self.config.device.info;
        let available = info.fmmu_count.filter(|count| *count > 0);
        let available = available.map_or(MAX_FMMUS, |count| count as usize);
        let fmmus = plan.fmmus(available.min(MAX_FMMUS))?;
        let mut all = self.to_init();
        all.extend(self.identity());
        all.extend(self.to_pre_op());
        all.extend(self.to_bootstrap());
        all.extend(self.back_to_pre_op(&plan.sync_managers, &fmmus));
        all.extend(self.to_safe_op(bus, &plan.sync_managers, &fmmus));
        all.extend(self.to_op(&plan.sync_managers, &fmmus));
        Ok(all)
    }

    fn timeouts(&self) -> StateTimeouts {
        StateTimeouts::new(&self.config.device.info)
    }

    fn write(&self, transitions: &[&str], comment: &str, ado: u16, data: &[u8]) -> EcatCommand {
        EcatCommand::new(transitions, comment, code::FPWR, self.station(), ado).data(data)
    }

    /// Writes to the position of the device, which may not have its station address yet.
    fn write_at(&self, transitions: &[&str], comment: &str, ado: u16, data: &[u8]) -> EcatCommand {
        let adp = self.auto_increment();
        EcatCommand::new(transitions, comment, code::APWR, adp, ado).data(data)
    }

    fn read_at(&self, transitions: &[&str], comment: &str, ado: u16, data: &[u8]) -> EcatCommand {
        let adp = self.auto_increment();
        EcatCommand::new(transitions, comment, code::APRD, adp, ado).data(data)
    }

    fn block(&self, transitions: &[&str], what: &str, block: &RegisterBlock) -> EcatCommand {
        self.write(transitions, what, block.register, &block.data)
            .cnt(1)
    }

    /// Requests a state and waits for it.
    fn change(
        &self,
        transitions: &[&str],
        state: u8,
        timeout: std::time::Duration,
    ) -> [EcatCommand; 2] {
        let name = match state {
            PRE_OP => "PREOP",
            BOOTSTRAP => "BOOT",
            SAFE_OP => "SAFEOP",
            _ => "OP",
        };
        let request = format!("set device state to {name}");
        let check = format!("check device state for {name}");
        let read = EcatCommand::new(
            transitions,
            &check,
            code::FPRD,
            self.station(),
            registers::AL_STATUS,
        );
        // On the way back, the request acknowledges an error.
        let up = transitions
            .iter()
            .any(|t| matches!(*t, "IP" | "IB" | "PS" | "SO"));
        let (request_code, mask) = match up {
            true => (state, STATE_AND_ERROR),
            false => (state | ACKNOWLEDGE, STATE),
        };
        [
            self.write(
                transitions,
                &request,
                registers::AL_CONTROL,
                &[request_code, 0],
            )
            .cnt(1),
            read.data(&[0; 2])
                .cnt(1)
                .validate(&[state, 0], &[mask, 0], milliseconds(timeout)),
        ]
    }

    fn to_init(&self) -> Vec<EcatCommand> {
        let timeout = milliseconds(self.timeouts().back_to_init);
        let request = [INIT | ACKNOWLEDGE, 0];
        let mut all = Vec::new();
        for transitions in [TO_INIT, LEAVE_INIT] {
            let set = "set device state to INIT";
            all.push(self.write_at(transitions, set, registers::AL_CONTROL, &request));
            let check = "check device state for INIT";
            let read = self.read_at(transitions, check, registers::AL_STATUS, &[0; 2]);
            all.push(read.validate(&[INIT, 0], &[STATE, 0], timeout));
        }
        all
    }

    /// Compares what the EEPROM says with the machine file, as bring-up does.
    fn identity(&self) -> Vec<EcatCommand> {
        let config = self.config;
        let identity = config.selection.identity;
        let mut all = vec![
            self.write_at(
                LEAVE_INIT,
                "assign EEPROM to ECAT",
                registers::EEPROM_CONFIGURATION,
                &[0],
            )
            .cnt(1),
        ];
        let mask = match config.identity {
            RevisionMatch::Equal => Some(&[][..]),
            RevisionMatch::HighWord => Some(&[0, 0, 0xff, 0xff][..]),
            RevisionMatch::LowWord => Some(&[0xff, 0xff, 0, 0][..]),
            RevisionMatch::Newer | RevisionMatch::Ignore => None,
        };
        for (word, what, value, mask) in [
            (
                0x08,
                "check vendor id",
                Some(identity.vendor),
                Some(&[][..]),
            ),
            (
                0x0a,
                "check product code",
                Some(identity.product),
                Some(&[][..]),
            ),
            (0x0c, "check revision no", Some(identity.revision), mask),
            (0x0e, "check serial no", config.serial, Some(&[][..])),
        ] {
            let (Some(value), Some(mask)) = (value, mask) else {
                continue;
            };
            let [r0, r1] = control::READ.to_le_bytes();
            let request = [r0, r1, word, 0, 0, 0];
            all.push(
                self.write_at(UP_TO_PRE_OP, what, registers::EEPROM_CONTROL, &request)
                    .cnt(1),
            );
            let value = value.to_le_bytes();
            let masked: Vec<u8> = value
                .iter()
                .enumerate()
                .map(|(n, byte)| byte & mask.get(n).unwrap_or(&0xff))
                .collect();
            all.push(
                self.read_at(UP_TO_PRE_OP, what, registers::EEPROM_DATA, &[0; 4])
                    .cnt(1)
                    .validate(&masked, mask, EEPROM_TIMEOUT_MS),
            );
        }
        if let Some(alias) = alias(config) {
            all.push(
                self.read_at(UP_TO_PRE_OP, "check the alias", ALIAS, &[0; 2])
                    .cnt(1)
                    .validate(&alias.to_le_bytes(), &[], EEPROM_TIMEOUT_MS),
            );
        }
        let station = self.station().to_le_bytes();
        all.push(
            self.write_at(
                LEAVE_INIT,
                "set physical address",
                registers::STATION_ADDRESS,
                &station,
            )
            .cnt(1),
        );
        all
    }

    fn to_pre_op(&self) -> Vec<EcatCommand> {
        let mut all = Vec::new();
        for block in mailbox_registers(self.config).into_iter().flatten() {
            let clear = [0; registers::SYNC_MANAGER_LEN as usize];
            let transitions = ["IP", "IB", "PI", "SI", "OI"];
            all.push(self.write(&transitions, "clear mailbox", block.register, &clear));
            all.push(self.block(UP_TO_PRE_OP, "set mailbox", &block));
        }
        let eeprom = registers::EEPROM_CONFIGURATION;
        all.push(
            self.write(LEAVE_INIT, "assign EEPROM to PDI", eeprom, &[1])
                .cnt(1),
        );
        all.extend(self.change(UP_TO_PRE_OP, PRE_OP, self.timeouts().pre_op));
        all.push(
            self.write(UP_TO_PRE_OP, "assign EEPROM back to ECAT", eeprom, &[0])
                .cnt(1),
        );
        all
    }

    fn to_bootstrap(&self) -> Vec<EcatCommand> {
        let (Some(areas), Some(mailboxes)) = (self.bootstrap(), mailbox_registers(self.config))
        else {
            return Vec::new();
        };
        let mut all = Vec::new();
        for (area, mut block) in areas.into_iter().zip(mailboxes) {
            if let Some(start) = block.data.first_chunk_mut() {
                *start = area;
            }
            all.push(self.block(&["IB"], "set mailbox of BOOT", &block));
        }
        all.extend(self.change(&["IB"], BOOTSTRAP, self.timeouts().pre_op));
        all
    }

    fn back_to_pre_op(&self, sms: &[RegisterBlock], fmmus: &[RegisterBlock]) -> Vec<EcatCommand> {
        let mut all = Vec::new();
        all.extend(self.change(BACK_TO_PRE_OP, PRE_OP, self.timeouts().back_to_init));
        for (what, blocks, len) in [
            ("clear FMMU", fmmus, FMMU_LEN),
            ("clear SyncManager", sms, registers::SYNC_MANAGER_LEN.into()),
        ] {
            for block in blocks {
                all.push(self.write(WITHOUT_PROCESS_DATA, what, block.register, &vec![0; len]));
            }
        }
        if self.config.selection.dc.is_some() {
            all.push(self.write(
                WITHOUT_PROCESS_DATA,
                "stop SYNC signals",
                registers::DC_CYCLIC_CONTROL,
                &[0; 2],
            ));
        }
        all
    }

    fn to_safe_op(
        &self,
        bus: &Bus,
        sms: &[RegisterBlock],
        fmmus: &[RegisterBlock],
    ) -> Vec<EcatCommand> {
        const PS: &[&str] = &["PS"];
        let mut all = Vec::new();
        all.extend(
            sms.iter()
                .map(|block| self.block(PS, "set SyncManager", block)),
        );
        all.extend(fmmus.iter().map(|block| self.block(PS, "set FMMU", block)));
        for (register, what, value) in watchdog_registers(bus) {
            // A controller may lack a watchdog, so no working counter is expected.
            all.push(self.write(PS, what, register, &value.to_le_bytes()));
        }
        if let Some(dc) = &self.config.selection.dc {
            for block in pulse_registers(dc, 0) {
                let what = match block.register {
                    registers::DC_START_TIME => {
                        "SYNC0 start time: the MainDevice writes its own, plus ShiftTime"
                    }
                    registers::DC_SYNC0_CYCLE => "SYNC0 cycle time",
                    registers::DC_SYNC1_CYCLE => "SYNC1 cycle time",
                    _ if block.data.iter().all(|byte| *byte == 0) => "stop SYNC signals",
                    _ => "AssignActivate",
                };
                all.push(self.block(PS, what, &block));
            }
        }
        all.extend(self.change(PS, SAFE_OP, self.timeouts().safe_op_op));
        all
    }

    fn to_op(&self, sms: &[RegisterBlock], fmmus: &[RegisterBlock]) -> Vec<EcatCommand> {
        let mut all = Vec::new();
        // SyncManagers before FMMUs: no output passes an FMMU to memory without a SyncManager.
        let late: Vec<u16> = sms
            .iter()
            .chain(fmmus)
            .filter_map(|block| block.op_only)
            .collect();
        for register in &late {
            all.push(self.write(&["SO"], "enable in OP", *register, &[1]).cnt(1));
        }
        all.extend(self.change(&["SO"], OP, self.timeouts().safe_op_op));
        for register in late.iter().rev() {
            all.push(self.write(LEAVE_OP, "disable outside OP", *register, &[0]));
        }
        all.extend(self.change(&["OS"], SAFE_OP, self.timeouts().back_to_safe_op));
        all
    }
}

impl Network<'_> {
    /// Returns the `Master` element: the frames' addresses and the commands for all devices.
    pub(super) fn main_device(&self) -> Element {
        let info = Element::new("Info")
            .with("Name", "ecaxis")
            .with("Destination", "ffffffffffff")
            .with("Source", "101010101010")
            .with("EtherType", "a488");
        let all = |comment: &str, ado: u16| {
            EcatCommand::new(UP_TO_PRE_OP, comment, code::BWR, 0, ado).before_slave()
        };
        let read = EcatCommand::new(
            UP_TO_PRE_OP,
            "count devices",
            code::BRD,
            0,
            registers::AL_STATUS,
        );
        let commands = [
            EcatCommand {
                cnt: self.device_count(),
                ..read.before_slave().data(&[0; 2])
            },
            all("clear FMMUs", registers::FMMU).length(FMMUS_LEN),
            all("clear SyncManagers", registers::SYNC_MANAGER).length(SYNC_MANAGERS_LEN),
            all("clear system time", registers::DC_SYSTEM_TIME).length(32),
            all("stop SYNC signals", registers::DC_ACTIVATION).data(&[0]),
            all("reset DC speed", registers::DC_SPEED_COUNTER_START).data(&[0, 0x10]),
            all("configure DC filter", registers::DC_SPEED_COUNTER_START + 4).data(&[0, 0x0c]),
        ];
        let commands = commands.iter().map(|command| command.to_element("InitCmd"));
        Element::new("Master")
            .child(info)
            .child(Element::new("InitCmds").with_children(commands))
    }
}

fn milliseconds(time: std::time::Duration) -> u32 {
    u32::try_from(time.as_millis()).unwrap_or(u32::MAX >> 1)
}
