//! Two processes, each with a simulated SubDevice, one behind the other: the second one is killed and
//! started again. Requires root.

use std::process::Stdio;
use std::time::{Duration, Instant};

use ecaxis_test_support::host::over_a_pair;
use ecaxis_test_support::program::{self, ProgramOutput};
use ecaxis_test_support::with_our_esi;
use ecaxis_tools::bench::veth::VethPair;
use rustix::process::Signal;

/// A drive without distributed clocks: the processes have no common time.
fn drive(name: &str, position: usize) -> String {
    format!(
        "\n[[device]]\nname = \"{name}\"\nesi = \"esi/EPOS4.xml\"\nposition = {position}\nmode = \"csp\"\ndc = \"off\"\n\
         [device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 2000\n\
         limits = {{ position = [-100.0, 100.0], velocity = 2.0, acceleration = 20.0, torque = 100.0, following_error = 5.0 }}\n\
         \n[[stop.group]]\nname = \"{name}\"\naxes = [\"{name}\"]\noutside = \"continue\"\n"
    )
}

fn file(text: &str) -> tempfile::NamedTempFile {
    let file = tempfile::Builder::new().suffix(".toml").tempfile();
    let file = file.expect("a temporary file");
    std::fs::write(file.path(), with_our_esi(text)).expect("written");
    file
}

fn serve(file: &tempfile::NamedTempFile, nics: &[&str]) -> ProgramOutput {
    let path = file.path().to_str().expect("a path in UTF-8");
    let arguments = ["sim", path].into_iter().chain(nics.iter().copied());
    let mut bus = ProgramOutput::start(program::command().args(arguments).stdout(Stdio::null()));
    bus.says("answer");
    bus
}

/// The device of a process that is killed and started again returns. The other axis moves on.
#[test]
fn device_of_a_killed_process_returns() {
    over_a_pair(|first| {
        let second = VethPair::new().expect("a second pair");
        let bus = "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n";
        let tolerant = "lost_frames = 400\nwatchdog = \"2s\"\n";
        let steps = "\n[[step]]\nenable = true\n\n[[step]]\nrepeat = 1000\n\
            \n[[step.step]]\nmove = { a = 3.0 }\n\n[[step.step]]\nmove = { a = -3.0 }\n";
        let [a, b] =
            [("a", 0), ("b", 0)].map(|(name, at)| file(&(bus.to_owned() + &drive(name, at))));
        let machine = file(&[bus, tolerant, &drive("a", 0), &drive("b", 1), steps].concat());
        let path = machine.path().to_str().expect("a path in UTF-8");
        let _near = serve(&a, &["--nic", &first.a, "--nic2", &second.a]);
        let far = serve(&b, &["--nic", &second.b]);
        let run = ["run", path, "--nic", &first.b, "--no-fault-report"];
        let mut run = ProgramOutput::start(program::command().args(run).stdout(Stdio::piped()));
        run.says("2 axes in Operation enabled");
        second.set(&second.b, false).expect("down");
        far.signal(Signal::KILL);
        far.end();
        run.says("the group `b` stops, the rest goes on");
        let _far = serve(&b, &["--nic", &second.b]);
        second.set(&second.b, true).expect("up");
        let began = Instant::now();
        run.says("`b` (position 1, station 0x1001) is in Op again");
        let after = began.elapsed();
        println!("in Op {after:?} after its link");
        assert!(after < Duration::from_secs(30));
        run.interrupt();
        let output = run.end();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(!errors.contains("the group `a` stops"), "{errors}");
    });
}
