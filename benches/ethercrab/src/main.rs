//! Exchanges process data cyclically with ethercrab's stock io_uring task, as in its example
//! `io-uring`:
//!
//! `bench-ethercrab --nic IF --bytes N --cycle-ns N --cycles N --cpu N --priority N`
//!
//! Each cycle sends one LRW of N bytes and nothing else. The frame of `ecaxis bench` is longer: it
//! also carries the clock, AL status and a diagnostic read. The output is the input of `ecaxis
//! bench --against`.

use std::collections::{BTreeMap, HashMap};
use std::env;
use std::error::Error;
use std::fmt::Write;
use std::time::Duration;

use ethercrab::std::tx_rx_task_io_uring;
use ethercrab::{Command, MainDevice, MainDeviceConfig, PduStorage, RetryBehaviour, Timeouts};
use futures_lite::future::block_on;

/// The logical address at which `ecaxis bench` maps its process data.
const LOGICAL: u32 = 0x0001_0000;
/// The time until the task listens.
const START: Duration = Duration::from_millis(200);
/// The number of ignored cycles, which include first frames and first page accesses.
const WARM_UP: u64 = 200;
/// The timeout after which a reply counts as lost. It is long, because ethercrab's task ends when a
/// reply arrives after its timeout.
const TIMEOUT: Duration = Duration::from_millis(500);

static STORAGE: PduStorage<16, { PduStorage::element_size(1486) }> = PduStorage::new();

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let given: HashMap<&str, &str> = arguments
        .chunks_exact(2)
        .map(|pair| (pair[0].as_str(), pair[1].as_str()))
        .collect();
    let option = |name: &str| {
        let value = given.get(name).copied();
        value.ok_or_else(|| format!("{name} is missing"))
    };
    let number = |name: &str| -> Result<u64, Box<dyn Error>> { Ok(option(name)?.parse()?) };
    let nic = option("--nic")?.to_owned();
    let bytes = usize::try_from(number("--bytes")?)?;
    let (cycle, cycles) = (number("--cycle-ns")?, number("--cycles")?);
    let (cpu, priority) = (number("--cpu")?, number("--priority")?);

    let (tx, rx, pdu_loop) = STORAGE.try_split().map_err(|()| "split twice")?;
    let (cpu, priority) = (usize::try_from(cpu)?, i32::try_from(priority)?);
    lock_memory();
    std::thread::spawn(move || {
        become_real_time(cpu, priority);
        if let Err(error) = tx_rx_task_io_uring(&nic, tx, rx) {
            eprintln!("the task ended: {error}");
            std::process::exit(1);
        }
    });
    std::thread::sleep(START);
    let timeouts = Timeouts {
        pdu: TIMEOUT,
        ..Timeouts::default()
    };
    let config = MainDeviceConfig {
        retry_behaviour: RetryBehaviour::None,
        ..MainDeviceConfig::default()
    };
    let maindevice = MainDevice::new(pdu_loop, timeouts, config);
    become_real_time(cpu, priority);
    let data = vec![0; bytes];
    println!("{}", block_on(turn(&maindevice, &data, cycle, cycles)));
    Ok(())
}

async fn turn(maindevice: &MainDevice<'_>, data: &[u8], cycle: u64, cycles: u64) -> String {
    let (mut round_trips, mut lateness) = (BTreeMap::new(), BTreeMap::new());
    let (mut lost, mut overruns) = (0_u64, 0_u64);
    let mut before = Usage::now();
    let mut next = now() + cycle;
    for n in 0..WARM_UP + cycles {
        if n == WARM_UP {
            before = Usage::now();
        }
        sleep_until(next);
        let woke = now();
        let answer = Command::lrw(LOGICAL)
            .ignore_wkc()
            .send_receive_slice(maindevice, data)
            .await;
        let back = now();
        if n >= WARM_UP {
            *lateness.entry(woke.saturating_sub(next)).or_insert(0_u64) += 1;
            match answer {
                // Measured from the wake-up; the lateness of the wake-up is reported separately.
                Ok(_) => {
                    *round_trips
                        .entry(back.saturating_sub(woke))
                        .or_insert(0_u64) += 1
                }
                Err(_) => lost += 1,
            }
        }
        next += cycle;
        let late = now();
        if late > next {
            let missed = (late - next) / cycle + 1;
            next += missed * cycle;
            overruns += if n >= WARM_UP { missed } else { 0 };
        }
    }
    let used = Usage::now();
    format!(
        "{{\"name\":\"ethercrab\",\"cycles\":{cycles},\"lost\":{lost},\"overruns\":{overruns},\
         \"release_to_input\":{},\"wake_up_lateness\":{},\"cpu_ns\":{},\"voluntary_switches\":{},\
         \"involuntary_switches\":{},\"minor_faults\":{},\"major_faults\":{}}}",
        pairs(&round_trips),
        pairs(&lateness),
        used.cpu_ns - before.cpu_ns,
        used.voluntary - before.voluntary,
        used.involuntary - before.involuntary,
        used.minor - before.minor,
        used.major - before.major,
    )
}

fn pairs(histogram: &BTreeMap<u64, u64>) -> String {
    let mut text = String::from("[");
    for (n, (nanos, count)) in histogram.iter().enumerate() {
        let comma = if n > 0 { "," } else { "" };
        let _ = write!(text, "{comma}[{nanos},{count}]");
    }
    text + "]"
}

fn now() -> u64 {
    // SAFETY: all-zero is a valid timespec.
    let mut t: libc::timespec = unsafe { std::mem::zeroed() };
    // SAFETY: `t` is valid for writes.
    unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &raw mut t) };
    u64::try_from(t.tv_sec).unwrap_or(0) * 1_000_000_000 + u64::try_from(t.tv_nsec).unwrap_or(0)
}

fn sleep_until(t: u64) {
    let request = libc::timespec {
        tv_sec: libc::time_t::try_from(t / 1_000_000_000).unwrap_or(libc::time_t::MAX),
        tv_nsec: libc::c_long::try_from(t % 1_000_000_000).unwrap_or(0),
    };
    // SAFETY: `request` lives through the call, and a null pointer for the remaining time is
    // allowed.
    unsafe {
        libc::clock_nanosleep(
            libc::CLOCK_MONOTONIC,
            libc::TIMER_ABSTIME,
            &raw const request,
            std::ptr::null_mut(),
        )
    };
}

fn lock_memory() {
    // SAFETY: the call takes no pointers.
    unsafe { libc::mlockall(libc::MCL_CURRENT | libc::MCL_FUTURE) };
}

/// Sets CPU and priority as far as permitted, like `ecaxis bench`.
fn become_real_time(cpu: usize, priority: i32) {
    // SAFETY: all-zero is a valid set, and `cpu` is checked against its size.
    unsafe {
        let mut set: libc::cpu_set_t = std::mem::zeroed();
        if cpu < 8 * size_of::<libc::cpu_set_t>() {
            libc::CPU_SET(cpu, &mut set);
            libc::sched_setaffinity(0, size_of::<libc::cpu_set_t>(), &raw const set);
        }
        let parameters = libc::sched_param {
            sched_priority: priority,
        };
        libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const parameters);
    }
}

/// Resource usage of the whole process.
#[derive(Clone, Copy)]
struct Usage {
    cpu_ns: u64,
    voluntary: u64,
    involuntary: u64,
    minor: u64,
    major: u64,
}

impl Usage {
    fn now() -> Self {
        // SAFETY: all-zero is a valid rusage.
        let mut usage: libc::rusage = unsafe { std::mem::zeroed() };
        // SAFETY: `usage` is valid for writes.
        unsafe { libc::getrusage(libc::RUSAGE_SELF, &raw mut usage) };
        let count = |n: libc::c_long| u64::try_from(n).unwrap_or(0);
        let nanos = |t: libc::timeval| {
            u64::try_from(t.tv_sec).unwrap_or(0) * 1_000_000_000
                + u64::try_from(t.tv_usec).unwrap_or(0) * 1_000
        };
        Self {
            cpu_ns: nanos(usage.ru_utime) + nanos(usage.ru_stime),
            voluntary: count(usage.ru_nvcsw),
            involuntary: count(usage.ru_nivcsw),
            minor: count(usage.ru_minflt),
            major: count(usage.ru_majflt),
        }
    }
}
