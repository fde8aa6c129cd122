//! The files of the page, embedded.

use axum::http::header;
use axum::response::{IntoResponse, Response};

/// One file of the page.
#[derive(Debug)]
pub struct PageFile {
    pub path: &'static str,
    pub kind: &'static str,
    pub bytes: &'static [u8],
}

macro_rules! files {
    ($($name:literal $kind:literal,)*) => {
        &[$(PageFile {
            path: concat!("/", $name),
            kind: $kind,
            bytes: include_bytes!(concat!("../page/", $name)),
        },)*]
    };
}

/// All files.
pub const FILES: &[PageFile] = files! {
    "index.html" "text/html; charset=utf-8",
    "style.css" "text/css; charset=utf-8",
    "icon.svg" "image/svg+xml",
    "app.js" "text/javascript; charset=utf-8",
    "axes.js" "text/javascript; charset=utf-8",
    "bus.js" "text/javascript; charset=utf-8",
    "connection.js" "text/javascript; charset=utf-8",
    "control.js" "text/javascript; charset=utf-8",
    "dom.js" "text/javascript; charset=utf-8",
    "events.js" "text/javascript; charset=utf-8",
    "plot.js" "text/javascript; charset=utf-8",
    "program.js" "text/javascript; charset=utf-8",
    "samples.js" "text/javascript; charset=utf-8",
    "scope.js" "text/javascript; charset=utf-8",
    "timing.js" "text/javascript; charset=utf-8",
};

impl PageFile {
    #[must_use]
    pub fn response(&self) -> Response {
        ([(header::CONTENT_TYPE, self.kind)], self.bytes).into_response()
    }
}

/// Returns the page itself.
#[must_use]
pub fn index() -> Response {
    let index = FILES.iter().find(|file| file.path == "/index.html");
    index.map_or_else(|| ().into_response(), PageFile::response)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_file_of_the_page_is_served() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/page");
        let mut there: Vec<String> = std::fs::read_dir(folder)
            .unwrap()
            .map(|entry| format!("/{}", entry.unwrap().file_name().to_string_lossy()))
            .filter(|name| !name.contains("LICENSE"))
            .collect();
        there.sort();
        let mut served: Vec<_> = FILES.iter().map(|file| file.path.to_owned()).collect();
        served.sort();
        assert_eq!(there, served);
    }
}
