//! Profile position, profile velocity and homing.

use super::*;

/// Returns the milliseconds until Statusword bit 10.
fn until_reached(rig: &mut Rig) -> u32 {
    let mut ms = 0;
    while rig.word() & 1 << 10 == 0 {
        rig.cycle();
        ms += 1;
        assert!(ms < 10_000);
    }
    ms
}

#[test]
fn pp_moves_on_the_edge_and_acknowledges() {
    let mut rig = rig();
    rig.set(0x6081, 0, 1500);
    rig.enable(1);
    assert_ne!(rig.word() & 1 << 10, 0);
    rig.set(0x607a, 0, 20_000);
    rig.cycles(20);
    assert_eq!(rig.get(0x6064), 0, "no edge, no move");
    rig.set(0x6040, 0, 0x1f);
    rig.cycles(2);
    assert_eq!(rig.word() & 0x1400, 0x1000, "acknowledged, on its way");
    rig.set(0x6040, 0, 0x0f);
    rig.cycles(2);
    assert_eq!(rig.word() & 0x1000, 0, "ready for the next");
    let ms = until_reached(&mut rig);
    // 10 turns at 25 rev/s and 166.7 rev/s².
    assert!((545..570).contains(&ms), "{ms}");
    rig.cycles(100);
    assert!((rig.get(0x6064) - 20_000).abs() <= 1);
}

#[test]
fn pp_buffers_one_set_point_or_changes_at_once() {
    let mut rig = rig();
    rig.enable(1);
    let command = |rig: &mut Rig, target, word| {
        rig.set(0x607a, 0, target);
        rig.set(0x6040, 0, word);
        rig.cycles(3);
        rig.set(0x6040, 0, 0x0f);
        rig.cycles(3);
    };
    command(&mut rig, 4000, 0x1f);
    command(&mut rig, 1000, 0x1f);
    assert_ne!(rig.word() & 0x1000, 0, "buffer full");
    let mut furthest = 0;
    for _ in 0..1500 {
        rig.cycle();
        furthest = furthest.max(rig.get(0x6064));
    }
    assert!((furthest - 4000).abs() <= 1, "{furthest}");
    assert!((rig.get(0x6064) - 1000).abs() <= 1);

    command(&mut rig, 10_000, 0x1f);
    command(&mut rig, 2000, 0x3f);
    furthest = 0;
    for _ in 0..1500 {
        rig.cycle();
        furthest = furthest.max(rig.get(0x6064));
    }
    assert!(furthest < 2500, "{furthest}");
    assert!((rig.get(0x6064) - 2000).abs() <= 1);

    command(&mut rig, -500, 0x5f);
    rig.cycles(800);
    assert!((rig.get(0x6064) - 1500).abs() <= 1, "relative");
}

/// Controlword bits 4 to 6 and 9, row by row: the positions of the axis during the move.
#[test]
fn set_point_handshake_row_by_row() {
    struct Row {
        word: i64,
        /// The second target, relative to the first target of 4000, or absolute.
        second: i64,
        end: i64,
        /// True if the axis stops at 4000 first.
        rests: bool,
    }
    let rows = [
        // One after the other; immediately; immediately and relative to the last accepted target.
        Row {
            word: 0x1f,
            second: 9000,
            end: 9000,
            rests: true,
        },
        Row {
            word: 0x3f,
            second: 9000,
            end: 9000,
            rests: false,
        },
        Row {
            word: 0x5f,
            second: 5000,
            end: 9000,
            rests: true,
        },
        Row {
            word: 0x7f,
            second: 5000,
            end: 9000,
            rests: false,
        },
        // Change on set-point: past 4000 at full speed.
        Row {
            word: 0x21f,
            second: 9000,
            end: 9000,
            rests: false,
        },
        Row {
            word: 0x25f,
            second: 5000,
            end: 9000,
            rests: false,
        },
        // Bit 5 has priority over bit 9.
        Row {
            word: 0x23f,
            second: 9000,
            end: 9000,
            rests: false,
        },
    ];
    for row in rows {
        let mut rig = rig();
        rig.set(0x6081, 0, 600);
        rig.enable(1);
        rig.set(0x607a, 0, 4000);
        rig.set(0x6040, 0, 0x1f);
        rig.cycles(3);
        rig.set(0x6040, 0, 0x0f);
        rig.cycles(100);
        rig.set(0x607a, 0, row.second);
        rig.set(0x6040, 0, row.word);
        rig.cycles(3);
        assert_ne!(rig.word() & 1 << 12, 0, "0x{:x}: acknowledged", row.word);
        rig.set(0x6040, 0, 0x0f);
        rig.cycles(3);
        let waits = row.word & 1 << 5 == 0;
        assert_eq!(rig.word() & 1 << 12 != 0, waits, "0x{:x}: full", row.word);
        let (mut slowest, mut at_full_speed) = (f64::MAX, 0);
        for _ in 0..1500 {
            rig.cycle();
            if (3900..=4100).contains(&rig.get(0x6064)) {
                slowest = slowest.min(rig.drive.velocity_rev_s());
            }
            at_full_speed += u32::from(rig.drive.velocity_rev_s() > 9.8);
        }
        assert_eq!(slowest < 2.0, row.rests, "0x{:x}: {slowest}", row.word);
        assert!(at_full_speed > 100);
        assert!((rig.get(0x6064) - row.end).abs() <= 1, "0x{:x}", row.word);
        assert_eq!(rig.word() & 0x1400, 0x0400, "0x{:x}", row.word);
    }
}

#[test]
fn pp_targets_beyond_the_software_limits_end_there() {
    let mut rig = rig();
    rig.set(0x607d, 1, -1000);
    rig.set(0x607d, 2, 3000);
    rig.enable(1);
    for (target, end, limited) in [(9000, 3000, true), (-9000, -1000, true), (50, 50, false)] {
        rig.set(0x607a, 0, target);
        for word in [0x1f, 0x0f] {
            rig.set(0x6040, 0, word);
            rig.run_ms(3);
        }
        rig.run_ms(900);
        assert!((rig.get(0x6064) - end).abs() <= 1, "{target}");
        assert_eq!(rig.word() & 1 << 11 != 0, limited, "{target}");
        assert_eq!(rig.drive.state(), State::OperationEnabled);
    }
}

/// 0x6067 and 0x6068.
#[test]
fn position_is_reached_after_its_time_in_the_window() {
    let reached = |window, time| {
        let mut rig = rig();
        rig.set(0x6067, 0, window);
        rig.set(0x6068, 0, time);
        rig.enable(1);
        rig.set(0x607a, 0, 2000);
        rig.set(0x6040, 0, 0x1f);
        rig.cycles(2);
        until_reached(&mut rig)
    };
    let plain = reached(0xffff_ffff, 0);
    let late = reached(10, 250);
    assert!((245..300).contains(&(late - plain)), "{plain} {late}");
}

#[test]
fn pp_continues_after_a_halt() {
    let mut rig = rig();
    rig.enable(1);
    rig.set(0x607a, 0, 20_000);
    rig.set(0x6040, 0, 0x1f);
    rig.cycles(200);
    rig.set(0x6040, 0, 0x10f);
    rig.cycles(300);
    let stood = rig.get(0x6064);
    assert!(stood > 1000 && stood < 19_000);
    assert_ne!(rig.word() & 1 << 10, 0, "speed is zero");
    rig.set(0x6040, 0, 0x0f);
    rig.cycles(2000);
    assert!((rig.get(0x6064) - 20_000).abs() <= 1);
}

#[test]
fn pv_ramps_to_its_speed() {
    let mut rig = rig();
    rig.enable(3);
    rig.cycles(5);
    assert_ne!(rig.word() & 1 << 12, 0, "speed is zero");
    rig.set(0x60ff, 0, 3000);
    rig.cycles(2);
    let ms = until_reached(&mut rig);
    assert!((295..340).contains(&ms), "{ms}");
    rig.cycles(100);
    assert!((rig.drive.velocity_rev_s() - 50.0).abs() < 0.5);
    assert_eq!(rig.word() & 1 << 12, 0);
}

#[test]
fn homing_method_37_takes_the_present_position() {
    let mut rig = Rig::new(PlantParams {
        initial_position: 777,
        ..PlantParams::default()
    });
    rig.set(0x6098, 0, 37);
    rig.enable(6);
    assert_eq!(rig.get(0x6064), 777);
    rig.set(0x6040, 0, 0x1f);
    rig.cycles(3);
    assert_eq!(rig.get(0x6064), 0);
    assert_eq!(rig.word() & 0x3400, 0x1400, "attained");

    rig.set(0x6098, 0, 5);
    rig.set(0x6040, 0, 0x0f);
    rig.cycles(5);
    rig.set(0x6040, 0, 0x1f);
    rig.cycles(3);
    assert_ne!(rig.word() & 1 << 13, 0, "no such method");
}

#[test]
fn unsupported_mode_keeps_the_old_one() {
    let mut rig = rig();
    rig.enable(8);
    for code in [0, 2, -1, 11] {
        rig.set(0x6060, 0, code);
        rig.cycles(3);
        assert_eq!(rig.get(0x6061), 8, "{code}");
    }
    assert_eq!(rig.get(0x6502), 0x3a5);
}

#[test]
fn mode_change_while_enabled_starts_at_the_actual_position() {
    let mut rig = rig();
    rig.enable(9);
    rig.set(0x60ff, 0, 300);
    rig.cycles(200);
    rig.set(0x60ff, 0, 0);
    rig.cycles(100);
    let here = rig.get(0x6064);
    rig.set(0x607a, 0, here);
    rig.set(0x6060, 0, 8);
    rig.cycles(100);
    assert_eq!(rig.get(0x6061), 8);
    assert!((rig.get(0x6064) - here).abs() <= 1);
    assert_eq!(rig.drive.state(), State::OperationEnabled);
}
