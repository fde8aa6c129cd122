//! Key presses and the requests that they cause.

use super::super::panel::tests::panel;
use super::*;

const X: AxisIndex = AxisIndex(0);
const Y: AxisIndex = AxisIndex(1);

fn request(asks: &[UiAction]) -> Option<Request> {
    match asks {
        [UiAction::For(request)] => Some(*request),
        _ => None,
    }
}

#[test]
fn single_key_press_moves_nothing() {
    let (mut ui, panel) = (Ui::default(), panel(2));
    assert_eq!(ui.key(Key::Right, 0, Some(&panel)), []);
    assert!(ui.armed(10));
    // Too late to be held: a second single press.
    assert_eq!(ui.key(Key::Right, REPEATS_WITHIN + 1, Some(&panel)), []);
}

#[test]
fn held_key_jogs_until_released() {
    let (mut ui, panel) = (Ui::default(), panel(2));
    let jog = |velocity| Some(Request::Jog { axis: X, velocity });
    let mut press = |key, now| request(&ui.key(key, now, Some(&panel)));
    assert_eq!(press(Key::Right, 0), None);
    // The keyboard's initial delay, then it repeats: 5 % of 100.
    for now in [500, 530, 560, 800] {
        assert_eq!(press(Key::Right, now), jog(5.0), "{now}");
    }
    // Released and pressed again.
    assert_eq!(
        press(Key::Right, 800 + HOLD_TO_RUN_TIMEOUT / 1_000_000 + 1),
        None
    );
    assert_eq!(press(Key::Right, 1_500), jog(5.0));
    // The opposite direction is another key.
    assert_eq!(press(Key::Left, 1_520), None);
    assert_eq!(press(Key::Left, 1_550), jog(-5.0));
    // A different key in between ends the hold.
    assert_eq!(press(Key::Char('+'), 1_560), None);
    assert_eq!(press(Key::Left, 1_570), None);
    assert_eq!(press(Key::Left, 1_600), jog(-10.0));
}

#[test]
fn speed_never_exceeds_the_maximum() {
    let (mut ui, panel) = (Ui::default(), panel(1));
    for _ in 0..20 {
        ui.key(Key::Char('+'), 0, Some(&panel));
    }
    assert_eq!(ui.speed(), MAX_MANUAL_SPEED);
    for _ in 0..20 {
        ui.key(Key::Char('-'), 0, Some(&panel));
    }
    assert_eq!(ui.speed(), SPEEDS[0]);
}

#[test]
fn unknown_keys_stop_all_axes() {
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
    // Before the bus is up, leaving is the only request.
    assert_eq!(ui.key(Key::Char('e'), 0, None), []);
    assert_eq!(ui.key(Key::Leave, 0, None), [UiAction::Leave]);
}

#[test]
fn ui_accepts_typed_positions() {
    let (mut ui, panel) = (Ui::default(), panel(1));
    let mut typed = |text: &str| {
        let keys = text.chars().map(|c| match c {
            '\r' => Key::Enter,
            '\x08' => Key::Backspace,
            c => Key::Char(c),
        });
        let asks: Vec<UiAction> = keys.flat_map(|key| ui.key(key, 0, Some(&panel))).collect();
        asks
    };
    let there = |position| {
        [UiAction::For(Request::MoveTo {
            axis: X,
            position,
            speed: SPEEDS[FIRST_SPEED],
        })]
    };
    assert_eq!(typed("m-12.5\r"), there(-12.5));
    assert_eq!(typed("m9\x087\r"), there(7.0));
    assert_eq!(typed("m\r"), []);
    assert_eq!(typed("m1-.\r"), [], "not a number");
    // `q` is not a digit: it stops and discards the input.
    assert_eq!(typed("m1q"), [UiAction::For(Request::StopAll)]);
    assert_eq!(typed("q"), [UiAction::Leave]);
    // An emergency stop works during input and discards it.
    assert_eq!(typed("m1x"), [UiAction::For(Request::EmergencyStop)]);
    assert_eq!(typed("2\r"), [UiAction::For(Request::StopAll); 2]);
    let long = format!("m{}\r", "9".repeat(500));
    assert_eq!(typed(&long).len(), 1);
}

#[test]
fn commands_address_the_selected_axis() {
    let (mut ui, panel) = (Ui::default(), panel(3));
    ui.key(Key::Down, 0, Some(&panel));
    for (key, expected) in [
        ('e', Request::Enable { axis: Y }),
        ('d', Request::Disable { axis: Y }),
        ('h', Request::Home { axis: Y }),
        ('r', Request::Reset { axis: Y }),
        ('x', Request::EmergencyStop),
        (
            '.',
            Request::MoveBy {
                axis: Y,
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
    // The selection wraps at both ends.
    for expected in [2, 0, 1] {
        ui.key(Key::Down, 0, Some(&panel));
        assert_eq!(ui.selected, AxisIndex(expected));
    }
    for expected in [0, 0] {
        ui.key(Key::Up, 0, Some(&panel));
        assert_eq!(ui.selected, AxisIndex(expected));
    }
}

#[test]
fn selecting_another_axis_stops_the_first() {
    let (mut ui, mut panel) = (Ui::default(), panel(2));
    panel.axes[X].doing = Activity::Jogging { velocity: 1.0 };
    let asks = ui.key(Key::Down, 0, Some(&panel));
    assert_eq!(request(&asks), Some(Request::Stop { axis: X }));
}
