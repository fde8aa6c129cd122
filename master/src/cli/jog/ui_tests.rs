//! Keys as somebody presses them: what they ask for, and what they do not.

use super::super::panel::tests::panel;
use super::*;

fn request(asks: &[Ask]) -> Option<Request> {
    match asks {
        [Ask::For(request)] => Some(*request),
        _ => None,
    }
}

#[test]
fn a_key_that_comes_once_moves_nothing() {
    let (mut ui, panel) = (Ui::default(), panel(2));
    assert_eq!(ui.key(Key::Right, 0, Some(&panel)), []);
    assert!(ui.armed(10));
    // Too late to be held down: a second single one.
    assert_eq!(ui.key(Key::Right, REPEATS_WITHIN + 1, Some(&panel)), []);
}

#[test]
fn a_key_that_is_held_down_jogs_for_as_long() {
    let (mut ui, panel) = (Ui::default(), panel(2));
    let jog = |velocity| Some(Request::Jog { axis: 0, velocity });
    let mut press = |key, now| request(&ui.key(key, now, Some(&panel)));
    assert_eq!(press(Key::Right, 0), None);
    // The keyboard's own delay, then it repeats: 5 % of 100.
    for now in [500, 530, 560, 800] {
        assert_eq!(press(Key::Right, now), jog(5.0), "{now}");
    }
    // Let go, and pressed again.
    assert_eq!(press(Key::Right, 800 + LET_GO / 1_000_000 + 1), None);
    assert_eq!(press(Key::Right, 1_500), jog(5.0));
    // The other way is another key.
    assert_eq!(press(Key::Left, 1_520), None);
    assert_eq!(press(Key::Left, 1_550), jog(-5.0));
    // And so is one that comes between.
    assert_eq!(press(Key::Char('+'), 1_560), None);
    assert_eq!(press(Key::Left, 1_570), None);
    assert_eq!(press(Key::Left, 1_600), jog(-10.0));
}

#[test]
fn no_speed_is_above_the_most() {
    let (mut ui, panel) = (Ui::default(), panel(1));
    for _ in 0..20 {
        ui.key(Key::Char('+'), 0, Some(&panel));
    }
    assert_eq!(ui.speed(), MOST_SPEED);
    for _ in 0..20 {
        ui.key(Key::Char('-'), 0, Some(&panel));
    }
    assert_eq!(ui.speed(), SPEEDS[0]);
}

#[test]
fn whatever_is_no_command_stops() {
    let (mut ui, panel) = (Ui::default(), panel(1));
    for key in [
        Key::Char(' '),
        Key::Escape,
        Key::FocusLost,
        Key::Other,
        Key::Char('z'),
        Key::Char('µ'),
        Key::Enter,
    ] {
        let asks = ui.key(key, 0, Some(&panel));
        assert_eq!(request(&asks), Some(Request::StopAll), "{key:?}");
    }
    assert_eq!(ui.key(Key::FocusGained, 0, Some(&panel)), []);
    // Before the bus is up there is nothing to ask for, but to leave.
    assert_eq!(ui.key(Key::Char('e'), 0, None), []);
    assert_eq!(ui.key(Key::Leave, 0, None), [Ask::Leave]);
}

#[test]
fn positions_are_typed() {
    let (mut ui, panel) = (Ui::default(), panel(1));
    let mut typed = |text: &str| {
        let keys = text.chars().map(|c| match c {
            '\r' => Key::Enter,
            '\x08' => Key::Backspace,
            c => Key::Char(c),
        });
        let asks: Vec<Ask> = keys.flat_map(|key| ui.key(key, 0, Some(&panel))).collect();
        asks
    };
    let there = |position| {
        [Ask::For(Request::MoveTo {
            axis: 0,
            position,
            speed: SPEEDS[FIRST_SPEED],
        })]
    };
    assert_eq!(typed("m-12.5\r"), there(-12.5));
    assert_eq!(typed("m9\x087\r"), there(7.0));
    assert_eq!(typed("m\r"), []);
    assert_eq!(typed("m1-.\r"), [], "not a number");
    // `q` is no digit: it stops, and what has been typed is gone.
    assert_eq!(typed("m1q"), [Ask::For(Request::StopAll)]);
    assert_eq!(typed("q"), [Ask::Leave]);
    // An emergency stop is one whatever is being typed, and nothing of it is left.
    assert_eq!(typed("m1x"), [Ask::For(Request::EmergencyStop)]);
    assert_eq!(typed("2\r"), [Ask::For(Request::StopAll); 2]);
    let long = format!("m{}\r", "9".repeat(500));
    assert_eq!(typed(&long).len(), 1);
}

#[test]
fn every_command_is_for_the_axis_that_is_chosen() {
    let (mut ui, panel) = (Ui::default(), panel(3));
    ui.key(Key::Down, 0, Some(&panel));
    for (key, expected) in [
        ('e', Request::Enable { axis: 1 }),
        ('d', Request::Disable { axis: 1 }),
        ('h', Request::Home { axis: 1 }),
        ('r', Request::Reset { axis: 1 }),
        ('x', Request::EmergencyStop),
        (
            '.',
            Request::MoveBy {
                axis: 1,
                distance: 1.0,
                speed: SPEEDS[FIRST_SPEED],
            },
        ),
    ] {
        let asks = ui.key(Key::Char(key), 0, Some(&panel));
        assert_eq!(request(&asks), Some(expected), "{key}");
    }
    ui.key(Key::Char('['), 0, Some(&panel));
    let asks = ui.key(Key::Char(','), 0, Some(&panel));
    let Some(Request::MoveBy { distance, .. }) = request(&asks) else {
        panic!("{asks:?}");
    };
    assert!((distance + 0.1).abs() < 1e-12, "{distance}");
    assert_eq!(ui.key(Key::Char('E'), 0, Some(&panel)).len(), 3);
    // Round and round; and never above the first.
    for expected in [2, 0, 1] {
        ui.key(Key::Down, 0, Some(&panel));
        assert_eq!(ui.selected, expected);
    }
    for expected in [0, 0] {
        ui.key(Key::Up, 0, Some(&panel));
        assert_eq!(ui.selected, expected);
    }
}

#[test]
fn who_looks_at_another_axis_lets_the_first_go() {
    let (mut ui, mut panel) = (Ui::default(), panel(2));
    panel.axes[0].doing = Doing::Jogging { velocity: 1.0 };
    let asks = ui.key(Key::Down, 0, Some(&panel));
    assert_eq!(request(&asks), Some(Request::Stop { axis: 0 }));
}
