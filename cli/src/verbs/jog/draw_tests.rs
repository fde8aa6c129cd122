//! All content fits the terminal and contains no control sequences that move the cursor.

use super::super::panel::tests::panel;
use super::*;
use ecaxis_ecat::index::AxisIndex;

fn drawn(panel: &Panel, messages: &Messages, size: (usize, usize)) -> Vec<String> {
    let ui = Ui::default();
    let picture = Screen {
        title: "jog  configs/demo.toml  the simulated bus",
        panel: Some(panel),
        messages,
        ui: &ui,
        now: 0,
        size,
        colours: false,
    };
    picture.rows()
}

#[test]
fn screen_draws_all_rows() {
    let mut panel = panel(2);
    panel.axes[AxisIndex(1)].trouble = Some("drive fault 0x8611: following error".to_owned());
    let mut messages = Messages::default();
    messages.show("bus in Op".to_owned(), false);
    for _ in 0..3 {
        messages.show("a0: refused: the axis is not enabled".to_owned(), true);
    }
    let rows = drawn(&panel, &messages, (80, 24));
    let expected = "\
\x20jog  configs/demo.toml  the simulated bus  0.0 s  lost 0  wkc 0

   axis     state                  mode     position   velocity   torque
 > a0       Operation enabled      CSP         1.500      0.000     0.00
   a1       Operation enabled      CSP         1.500      0.000     0.00

 a0 holds  target 1.5 mm  following error 0.0000 mm
 limits  -50 … 50 mm, 100 mm/s, 100 %
 speed   5 % = 5 mm/s   step 1 mm


 bus in Op
 a0: refused: the axis is not enabled  (3 times)







 hold ←/→ jog   , . step   [ ] step size   - + speed   m move to   h home
 ↑/↓ axis   e/d enable/disable   E/D all   o mode   r reset   q quit
 space, Esc or any other key: all axes brake
 x: EMERGENCY STOP, the shortest way to no motion and no power";
    assert_eq!(rows.join("\n"), expected);
    assert_eq!(rows.len(), 24);
}

#[test]
fn screen_fits_any_terminal() {
    let mut many = panel(100);
    for axis in &mut many.axes {
        axis.name = "a very long name of an axis\u{1b}[2J\n".to_owned();
        axis.position = -1e12;
        axis.trouble = Some("trouble ".repeat(50));
    }
    let mut messages = Messages::default();
    for n in 0..200 {
        messages.show(format!("{n} {}", "much\r\n\u{7}".repeat(50)), n % 2 == 0);
    }
    for size in [(80, 24), (60, 16), (200, 60), (20, 5), (1, 1)] {
        let rows = drawn(&many, &messages, size);
        assert!(rows.len() <= size.1, "{size:?}");
        for row in &rows {
            assert!(row.chars().count() <= size.0, "{size:?}: {row}");
            assert!(!row.contains(char::is_control), "{row:?}");
        }
    }
    assert!(drawn(&Panel::default(), &Messages::default(), (80, 24)).len() <= 24);
}

#[test]
fn screen_is_complete_without_colours() {
    let (panel, messages, ui) = (panel(2), Messages::default(), Ui::default());
    let picture = Screen {
        title: "jog",
        panel: Some(&panel),
        messages: &messages,
        ui: &ui,
        now: 0,
        size: (80, 24),
        colours: true,
    };
    let coloured = picture.rows().join("\n");
    assert!(coloured.contains("\u{1b}["));
    let plain = Screen {
        colours: false,
        ..picture
    };
    let plain = plain.rows().join("\n");
    assert_eq!(anstream::adapter::strip_str(&coloured).to_string(), plain);
}
