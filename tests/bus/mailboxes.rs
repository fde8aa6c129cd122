//! Mailboxes during cyclic operation: emergencies from bring-up to the end, and transfers of
//! several callers.

use std::sync::Arc;

use ecaxis_master::bringup::Step;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::Machine;
use ecaxis_master::mailbox::{MailboxError, Mailboxes};
use ecaxis_master::session::{self, Cause, EmergencyReport, Observer, Options, Outcome, Progress};
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::{Heard, axes, faults, machine, run, virtual_time};

fn emergencies(heard: &Heard) -> Vec<&EmergencyReport> {
    let each = heard.0.iter().filter_map(|progress| match progress {
        Progress::Emergency(report) => Some(report),
        _ => None,
    });
    each.collect()
}

fn script(times: &[(&str, u32, u16)]) -> String {
    let each = times.iter().map(|(at, device, code)| {
        format!(
            "[[fault]]\nkind = \"emergency\"\nat = \"{at}\"\ndevice = {device}\ncode = {code:#06x}\n"
        )
    });
    each.collect()
}

/// Returns the devices of `configs/` with mailbox status in the process image, and the same devices
/// without it.
fn with_and_without_status_fmmu() -> [(&'static str, Machine); 2] {
    let without = with_esi(&axes(2), "<Fmmu>MBoxState</Fmmu>", "");
    [
        ("with status FMMU", machine(&axes(2))),
        ("without", without),
    ]
}

/// Parses a machine file with a changed ESI of its drives.
fn with_esi(text: &str, old: &str, new: &str) -> Machine {
    let bench = Bench::new();
    bench.change("esi/EPOS4.xml", |esi| esi.replace(old, new));
    bench.machine(text)
}

#[test]
fn every_emergency_is_reported_once_from_bring_up_to_the_end() {
    let sent = [
        ("5ms", 0, 0x1000),
        ("24ms", 0, 0x1001),
        ("30ms", 1, 0x1002),
        ("400ms", 0, 0x1003),
        ("1500ms", 1, 0x1004),
        ("1500ms", 1, 0x1005),
        ("1501ms", 0, 0x1006),
        ("2500ms", 1, 0x1007),
    ];
    for (way, machine) in with_and_without_status_fmmu() {
        let (outcome, heard) = run(machine, faults(&script(&sent)));
        outcome
            .result
            .unwrap_or_else(|error| panic!("{way}: {error}"));
        let reported: Vec<_> = emergencies(&heard)
            .iter()
            .map(|report| (report.device.clone(), report.emergency.code))
            .collect();
        // Devices in Init send no emergencies, so the first one is lost.
        let mut expected: Vec<_> = sent[1..]
            .iter()
            .map(|&(_, device, code)| (format!("a{device}"), code))
            .collect();
        let mut sorted = reported.clone();
        sorted.sort();
        expected.sort();
        assert_eq!(sorted, expected, "{way}: {reported:?}");
        let summary = outcome.summary.expect("a summary");
        assert_eq!(summary.emergencies.len(), reported.len(), "{way}");
        assert_eq!(summary.more_emergencies, 0);
        let codes = summary.emergencies.iter().map(|line| line.code);
        assert!(codes.eq(reported.iter().map(|(_, code)| *code)));
        for line in &summary.emergencies {
            let in_bring_up = line.at_s < 0.0;
            assert_eq!(line.dc_time_ns.is_none(), in_bring_up, "{way}: {line:?}");
        }
        let in_bring_up = summary.emergencies.iter().filter(|line| line.at_s < 0.0);
        assert!(in_bring_up.count() >= 2, "{way}: {:?}", summary.emergencies);
    }
}

#[test]
fn emergencies_have_the_time_of_their_arrival() {
    let script = script(&[("1500ms", 1, 0x5000), ("1750ms", 1, 0x5001)]);
    let many = ("thirty status FMMUs", machine(&axes(30)));
    for (way, machine) in with_and_without_status_fmmu().into_iter().chain([many]) {
        let (outcome, heard) = run(machine, faults(&script));
        outcome.result.expect("emergencies alone stop nothing");
        let reported = emergencies(&heard);
        let [first, second] = reported[..] else {
            panic!("{way}: {reported:?}")
        };
        let apart = |a: u64, b: u64| (b - a).abs_diff(250_000_000);
        // Every second cycle of 1 ms serves mailboxes: eight at once, or one.
        assert!(
            apart(first.at, second.at) < 30_000_000,
            "{way}: {reported:?}"
        );
        let (Some(a), Some(b)) = (first.dc_time, second.dc_time) else {
            panic!("{way}: {reported:?}")
        };
        assert!(apart(a, b) < 30_000_000, "{way}: {reported:?}");
    }
}

#[test]
fn a_fault_report_contains_the_emergency_of_the_drive() {
    let script = "[[fault]]\nkind = \"drive-fault\"\nat = \"1.5s\"\ndevice = 1\ncode = 0x7320\n";
    let (outcome, _) = run(machine(&axes(2)), faults(script));
    let error = outcome.result.as_ref().expect_err("it failed");
    let Cause::DriveFault { code, report, .. } = &*error.cause else {
        panic!("{:?}", outcome.result)
    };
    assert_eq!(*code, Some(0x7320));
    let codes: Vec<_> = report
        .emergencies
        .iter()
        .map(|r| r.emergency.code)
        .collect();
    assert_eq!(codes, [0x7320]);
    let text = outcome.result.expect_err("it failed").to_string();
    assert!(text.contains("; emergency 0x7320 ("), "{text}");
}

#[test]
fn the_diagnosis_history_of_a_faulty_device_is_read() {
    let coe = "<CoE SdoInfo=\"1\" PdoAssign=\"1\"";
    let machine = with_esi(&axes(2), coe, &format!("{coe} DiagHistory=\"1\""));
    let emergencies = (0..9).map(|n| (format!("{}ms", 1000 + 20 * n), 0x6100 + n));
    let mut script: String = emergencies
        .map(|(at, code)| {
            format!(
                "[[fault]]\nkind = \"emergency\"\nat = \"{at}\"\ndevice = 1\ncode = {code:#06x}\n"
            )
        })
        .collect();
    script += "[[fault]]\nkind = \"drive-fault\"\nat = \"1.5s\"\ndevice = 1\ncode = 0x7320\n";
    let (outcome, _) = run(machine, faults(&script));
    let error = outcome.result.as_ref().expect_err("it failed");
    let Cause::DriveFault { report, .. } = &*error.cause else {
        panic!("{:?}", outcome.result)
    };
    // The device keeps eight messages: the two newest are at the start, the third is at the end.
    let codes: Vec<_> = report.history.iter().map(|m| m.code).collect();
    assert_eq!(codes, [0x7320_e800, 0x6108_e800, 0x6107_e800]);
    assert!(report.history.iter().all(|m| m.time > 0), "{report:?}");
    let text = outcome.result.expect_err("it failed").to_string();
    assert!(text.contains("0x7320e800"), "{text}");
}

/// Gives the mailboxes to a user on a thread with its own tokio runtime, and ends the run when the
/// user is done.
struct WithUser<F> {
    user: Option<F>,
    stop: Arc<CancelToken>,
    thread: Option<std::thread::JoinHandle<()>>,
    heard: Heard,
}

impl<F> Observer for WithUser<F>
where
    F: AsyncFnOnce(Mailboxes) + Send + 'static,
{
    fn progress(&mut self, progress: &Progress) {
        self.heard.progress(progress);
        if let Progress::Mailboxes(mailboxes) = progress
            && let Some(user) = self.user.take()
        {
            let (mailboxes, stop) = (mailboxes.clone(), Arc::clone(&self.stop));
            self.thread = Some(std::thread::spawn(move || {
                let runtime = tokio::runtime::Builder::new_current_thread()
                    .enable_time()
                    .build()
                    .expect("a runtime");
                let _ended = EndsTheRun(stop);
                runtime.block_on(user(mailboxes));
            }));
        }
    }
}

/// Ends the run when dropped, however the user ends.
struct EndsTheRun(Arc<CancelToken>);

impl Drop for EndsTheRun {
    fn drop(&mut self) {
        self.0.cancel();
    }
}

/// Runs a machine with this number of axes at rest until the user is done.
fn with_user<F>(axis_count: usize, options: Options, user: F) -> (Outcome, Heard)
where
    F: AsyncFnOnce(Mailboxes) + Send + 'static,
{
    with_user_of(machine(&axes(axis_count)), options, user)
}

/// Runs a machine at rest until the user is done, at most one hour.
pub(crate) fn with_user_of<F>(machine: Machine, options: Options, user: F) -> (Outcome, Heard)
where
    F: AsyncFnOnce(Mailboxes) + Send + 'static,
{
    let stop = Arc::<CancelToken>::default();
    let mut observer = WithUser {
        user: Some(user),
        stop: Arc::clone(&stop),
        thread: None,
        heard: Heard::default(),
    };
    let options = Options {
        limit: Some(3_600_000_000_000),
        enable: false,
        ..options
    };
    let outcome = session::run(machine, options, stop, &mut observer);
    let thread = observer.thread.expect("the user was asked");
    thread.join().expect("the user's expectations hold");
    (outcome, observer.heard)
}

#[test]
fn users_read_and_write_in_cyclic_operation() {
    const VENDOR: [u8; 4] = 0x0e0a_u32.to_le_bytes();
    let (outcome, _) = with_user(3, virtual_time(), async |mailboxes| {
        assert!(mailboxes.names().eq(["a0", "a1", "a2"]));
        let each = async |name: &str, value: u32| {
            let mailbox = mailboxes.device(name).expect("it is there");
            for round in 0..10_u32 {
                assert_eq!(mailbox.upload(0x1018, 1).await, Ok(VENDOR.to_vec()));
                let value = (value + round).to_le_bytes();
                mailbox.download(0x6065, 0, &value).await.expect("written");
                assert_eq!(mailbox.upload(0x6065, 0).await, Ok(value.to_vec()));
                // These drives do not support complete access.
                let whole = mailbox.upload_complete(0x1018, 0).await;
                assert!(matches!(whole, Err(MailboxError::Sdo { .. })), "{whole:?}");
            }
        };
        tokio::join!(each("a0", 1000), each("a1", 2000), each("a2", 3000));

        let unknown = mailboxes.upload("b", 0x1018, 1).await;
        assert_eq!(unknown, Err(MailboxError::Unknown { name: "b".into() }));
        let aborted = mailboxes.upload("a1", 0x2fff, 0).await;
        let Err(MailboxError::Sdo { name, source }) = aborted else {
            panic!("{aborted:?}")
        };
        assert_eq!(
            (name.as_str(), source.abort_code()),
            ("a1", Some(0x0602_0000))
        );
        let read_only = mailboxes.download("a0", 0x1018, 1, &[0; 4]).await;
        let Err(MailboxError::Sdo { source, .. }) = read_only else {
            panic!("{read_only:?}")
        };
        assert_eq!(source.abort_code(), Some(0x0601_0002));
    });
    outcome.result.expect("an undisturbed run");
    let summary = outcome.summary.expect("a summary");
    assert_eq!(
        summary.counters.lost_frames + summary.counters.wkc_errors,
        0
    );
}

/// Each future is polled once and dropped, some in the queue, some during their transfer.
#[test]
fn dropped_futures_leave_no_transfer_behind() {
    let (outcome, _) = with_user(1, virtual_time(), async |mailboxes| {
        let mailbox = mailboxes.device("a0").expect("it is there");
        for round in 0..40_u64 {
            let long = mailbox.upload(0x1008, 0);
            let timeout = std::time::Duration::from_micros(50 * (round % 8));
            let _ = tokio::time::timeout(timeout, long).await;
            if round % 4 == 3 {
                let name = mailbox.upload(0x1008, 0).await.expect("read");
                assert!(!name.is_empty());
                assert_eq!(mailbox.upload(0x6041, 0).await.map(|s| s.len()), Ok(2));
            }
        }
    });
    outcome.result.expect("an undisturbed run");
}

#[test]
fn transfers_continue_during_emergencies() {
    let sent: Vec<(String, u16)> = (0..60)
        .map(|n| (format!("{}ms", 600 + 7 * n), 0x9000 + n))
        .collect();
    let sent: Vec<_> = sent
        .iter()
        .map(|(at, code)| (at.as_str(), 0, *code))
        .collect();
    let options = faults(&script(&sent));
    let (outcome, heard) = with_user(1, options, async |mailboxes| {
        let mailbox = mailboxes.device("a0").expect("it is there");
        for round in 0..200_u32 {
            let value = round.to_le_bytes();
            mailbox.download(0x6065, 0, &value).await.expect("written");
            assert_eq!(mailbox.upload(0x6065, 0).await, Ok(value.to_vec()));
        }
        // The script continues for a second.
        tokio::time::sleep(std::time::Duration::from_millis(300)).await;
    });
    outcome.result.expect("an undisturbed run");
    let codes: Vec<u16> = emergencies(&heard)
        .iter()
        .map(|r| r.emergency.code)
        .collect();
    assert_eq!(codes, (0x9000..0x9000 + 60).collect::<Vec<_>>());
}

#[test]
fn mailbox_access_fails_after_the_run() {
    let kept = Arc::new(std::sync::Mutex::new(None));
    let keeps = Arc::clone(&kept);
    with_user(1, virtual_time(), async move |mailboxes| {
        *keeps.lock().expect("no panic while it is locked") = Some(mailboxes);
    });
    let mailboxes = kept
        .lock()
        .expect("no panic while it is locked")
        .take()
        .expect("kept");
    let runtime = tokio::runtime::Builder::new_current_thread()
        .build()
        .expect("a runtime");
    let asked = runtime.block_on(mailboxes.upload("a0", 0x1018, 1));
    assert_eq!(asked, Err(MailboxError::Closed { name: "a0".into() }));
}

/// Returns the devices of `axes` with additional keys in each table.
fn with_start_up(more: &str) -> Machine {
    let text = axes(2);
    let mode = "mode = \"csp\"\n";
    assert!(text.contains(mode), "{text}");
    machine(&text.replace(mode, &format!("{mode}{more}\n")))
}

#[test]
fn startup_sdos_that_a_device_already_holds_are_skipped() {
    for (more, leaves_out) in [
        ("", false),
        ("startup = { skip_equal = true }", true),
        ("startup = { skip_equal = true, verify = true }", true),
    ] {
        let (outcome, heard) = run(with_start_up(more), virtual_time());
        outcome
            .result
            .unwrap_or_else(|error| panic!("{more}: {error}"));
        let reported = heard.0.iter().filter_map(|progress| match progress {
            Progress::Step(Step::Held { device, held, of }) => Some((device.as_str(), *held, *of)),
            _ => None,
        });
        let reported: Vec<_> = reported.collect();
        let devices: Vec<_> = reported.iter().map(|(device, ..)| *device).collect();
        assert_eq!(
            devices,
            if leaves_out { vec!["a0", "a1"] } else { vec![] },
            "{more}"
        );
        for (_, held, of) in reported {
            assert!(0 < held && held < of, "{more}: {held} of {of}");
        }
    }
}

#[test]
fn a_startup_sdo_that_is_not_stored_stops_bring_up_with_verification() {
    let script = "[[fault]]\nkind = \"sdo-ignored\"\ndevice = 1\nindex = 0x6065\nsub = 0\n";
    let sdo = "sdo = [{ index = 0x6065, value = 5678 }]";
    let (outcome, _) = run(with_start_up(sdo), faults(script));
    outcome.result.expect("a run without observers");
    let verified = sdo.replace(" }", ", verify = true }");
    let (outcome, _) = run(with_start_up(&verified), faults(script));
    let reported = outcome
        .result
        .expect_err("it holds another value")
        .to_string();
    for part in ["`a1`", "0x6065", "Following error window", "0x0000162e"] {
        assert!(reported.contains(part), "{part}: {reported}");
    }
}

/// ETG.2000, `Info/Mailbox/Timeout/ResponseTimeout`: the time in which a device answers. The first
/// answer of this device takes 6.5 s, longer than the default of 6 s (`mailbox::Timeouts`).
#[test]
fn a_slow_mailbox_has_the_time_of_its_esi() {
    let run_slow = |response: &str| {
        let bench = Bench::new();
        bench.write("own.xml", &bench.read("esi/MIO2.xml"));
        bench.change("own.xml", |esi| {
            let info = format!(
                "<Info><Mailbox><Timeout><RequestTimeout>100</RequestTimeout>{response}</Timeout>\
                 </Mailbox></Info><GroupType>"
            );
            esi.replacen("<GroupType>", &info, 1)
        });
        let machine = bench.machine(
            "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n\
             [[device]]\nname = \"io\"\nesi = \"own.xml\"\nposition = 0\n[[step]]\ndwell = \"20ms\"\n",
        );
        let silent =
            "[[fault]]\nkind = \"mailbox-silent\"\ndevice = 0\nat = \"0ms\"\nfor = \"6500ms\"\n";
        let (outcome, _) = run(machine, faults(silent));
        outcome.result.map_err(|error| error.to_string())
    };
    let long = "<ResponseTimeout>7000</ResponseTimeout>";
    assert_eq!(run_slow(long), Ok(()));
    for short in ["", "<ResponseTimeout>2000</ResponseTimeout>"] {
        let error = run_slow(short).expect_err("too slow");
        assert!(
            error.contains("`io`") && error.contains("no answer"),
            "{error}"
        );
    }
}
