//! A recording and its analysis: the report as JSON and as a page.
#![no_main]

use ecaxis_master::recording::Reader;
use ecaxis_tools::analyze::{Context, analyze, document};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|file: &[u8]| {
    let report = analyze(vec![Reader::new(file)], None, Context::default());
    assert!(
        document("x", &report, &[], true)
            .html()
            .ends_with("</html>\n")
    );
});
