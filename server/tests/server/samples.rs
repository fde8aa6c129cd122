//! The ring of samples, and the history made of it.

use std::sync::atomic::{AtomicBool, Ordering};

use ecaxis_master::rt::samples::CycleSample;
use ecaxis_master::samples::{SampleLayout, Samples};
use ecaxis_server::sampler::Sampler;

use crate::harness::demo;

const CYCLE_NS: u64 = 1_000_000;

fn ring(rows: u64) -> Samples {
    Samples::create(SampleLayout::new(&demo()), rows * CYCLE_NS).unwrap()
}

/// Each number of row `n` follows from `n`, so that a torn row shows.
fn row(n: u64) -> CycleSample {
    CycleSample {
        time: n * CYCLE_NS,
        number: n,
        wake_up: n,
        work: n,
        ..CycleSample::default()
    }
}

#[test]
fn a_reader_that_keeps_up_misses_none_of_a_million_rows() {
    let samples = ring(4096);
    let mut writer = samples.writer().unwrap();
    let (mut next, mut expected, mut missed) = (0, 0, 0);
    for n in 0..1_000_000 {
        writer.write(&row(n), &[], &[], &[]);
        if n % 1000 == 999 {
            missed += samples.read_new(&mut next, |number, words| {
                assert_eq!((number, words[2]), (expected, expected));
                expected += 1;
            });
        }
    }
    assert_eq!((expected, missed), (1_000_000, 0));
}

#[test]
fn a_slow_reader_learns_how_many_rows_it_missed() {
    let samples = ring(4096);
    let mut writer = samples.writer().unwrap();
    for n in 0..10_000 {
        writer.write(&row(n), &[], &[], &[]);
    }
    let (mut next, mut first, mut count) = (0, None, 0);
    let missed = samples.read_new(&mut next, |number, _| {
        first.get_or_insert(number);
        count += 1;
    });
    assert_eq!(
        (missed, first, count),
        (10_000 - 4096, Some(10_000 - 4096), 4096)
    );
}

/// A writer that laps the reader: each row that is read is whole, and read and missed add up.
#[test]
fn no_torn_row_is_read() {
    let (samples, done) = (ring(1), AtomicBool::new(false));
    let mut writer = samples.writer().unwrap();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            (0..2_000_000).for_each(|n| writer.write(&row(n), &[], &[], &[]));
            done.store(true, Ordering::Release);
        });
        let (mut next, mut read, mut missed, mut last) = (0, 0, 0, false);
        while !last {
            last = done.load(Ordering::Acquire);
            missed += samples.read_new(&mut next, |number, words| {
                let seconds = (number as f64 * 1e-9).to_bits();
                assert_eq!(
                    (words[0], words[1], words[2]),
                    (number + 1, number * CYCLE_NS, number)
                );
                assert_eq!((words[4], words[7]), (seconds, seconds));
                read += 1;
            });
        }
        assert_eq!(read + missed, 2_000_000);
    });
}

/// One late cycle in an hour of 1 ms is in the widest view.
#[test]
fn a_spike_of_one_cycle_in_an_hour_is_visible() {
    const SPIKE: u64 = 1_234_567;
    let samples = ring(4096);
    let mut writer = samples.writer().unwrap();
    let sampler = Sampler::new(samples.layout().signals.len(), CYCLE_NS);
    for n in 0..3_600_000 {
        let wake_up = if n == SPIKE { 900_000 } else { 1000 };
        writer.write(&CycleSample { wake_up, ..row(n) }, &[], &[], &[]);
        if n % 2000 == 1999 {
            sampler.take_new(&samples);
        }
    }
    assert_eq!(sampler.missed(), 0);
    let word = samples.layout().signal("bus.wake_up").unwrap().word;
    let history = sampler.history(&samples, &[word], [0, u64::MAX], 100);
    let [least, greatest] = &history.signals[0];
    let high: Vec<usize> = (0..greatest.len())
        .filter(|n| greatest[*n] > 0.5e-3)
        .collect();
    let [bucket] = high[..] else {
        panic!("{high:?}")
    };
    assert!((greatest[bucket] - 900e-6).abs() < 1e-12 && (least[bucket] - 1e-6).abs() < 1e-12);
    let begin = history.times_ns[bucket];
    let end = history
        .times_ns
        .get(bucket + 1)
        .copied()
        .unwrap_or(u64::MAX);
    assert!((begin..end).contains(&(SPIKE * CYCLE_NS)));
}
