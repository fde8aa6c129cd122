//! HTTP and WebSocket: the page, the operations, samples, history and metrics.

use std::collections::HashSet;
use std::fs::{File, Metadata};
use std::io::{self, Read as _};
use std::net::{IpAddr, SocketAddr};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{DefaultBodyLimit, Path, Query, Request as HttpRequest, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, Uri, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use rustix::fs::OFlags;
use serde::Deserialize;
use serde_json::{Map, Value, json};
use tokio::net::TcpListener;

use crate::admission;
use crate::bulk::{Bulk, Pieces};
use crate::client::{Answer, Client};
use crate::command::Request;
use crate::connection::{Batch, signal_words};
use crate::error::{ErrorCode, OpError};
use crate::export;
use crate::foxglove::{self, Viewers};
use crate::hub::Hub;
use crate::openapi;
use crate::page;
use crate::socket::LINE;
use crate::tokens::{Rights, Tokens};
use crate::{strict, websocket};

/// The most buckets of one history.
const BUCKETS: usize = 20_000;
/// The most values of one answer: 4 MB.
const VALUES: usize = 1 << 19;
/// The time for the body of a request.
const BODY: Duration = Duration::from_secs(10);
/// The bytes of a recording that are read at once.
const PIECE: usize = 256 * 1024;

/// Settings of the HTTP server.
#[derive(Debug, Clone)]
pub struct HttpOptions {
    pub address: SocketAddr,
    /// Clients with the token may command.
    pub control: bool,
    pub token: String,
    /// A token that permits reading only.
    pub watch_token: Option<String>,
    /// The token is known to its users: it is not printed.
    pub known_token: bool,
    /// Further names that the `Host` header may contain.
    pub hosts: Vec<String>,
    pub recordings: Option<PathBuf>,
}

/// What every handler needs.
#[derive(Debug)]
pub struct Http {
    pub hub: Arc<Hub>,
    pub(crate) viewers: Viewers,
    bulk: Bulk,
    pub(crate) options: HttpOptions,
    pub(crate) tokens: Arc<Tokens>,
    /// The clients of all requests with the right to command, with that to read, and without a token.
    commanding: Client,
    reading: Client,
    pub(crate) without_token: Client,
}

pub(crate) type Shared = State<Arc<Http>>;

/// A server that listens.
#[derive(Debug)]
pub struct HttpServer {
    listener: TcpListener,
    http: Arc<Http>,
}

impl HttpServer {
    /// Binds the address.
    ///
    /// # Errors
    /// Fails if the system refuses the address.
    pub async fn bind(hub: &Arc<Hub>, mut options: HttpOptions) -> io::Result<Self> {
        let listener = TcpListener::bind(options.address).await?;
        options.address = listener.local_addr()?;
        let no_token = OpError::new(ErrorCode::NoToken, "this needs the token")
            .help("use the address that the server printed");
        let (token, watch) = (options.token.clone(), options.watch_token.clone());
        let tokens = Tokens::new(token, watch, options.control);
        let with = |refusal| Client::new(Arc::clone(hub), "http", refusal, true);
        let http = Http {
            commanding: with(None),
            reading: with(tokens.refusal(Rights::Read)),
            without_token: with(Some(no_token)),
            tokens: Arc::new(tokens),
            hub: Arc::clone(hub),
            viewers: Viewers::new(),
            bulk: Bulk::default(),
            options,
        };
        http.without_token.set_blind(!http.is_loopback());
        Ok(Self {
            listener,
            http: Arc::new(http),
        })
    }

    /// Returns the address, with the token unless it is known.
    #[must_use]
    pub fn url(&self) -> String {
        let Http { options, .. } = &*self.http;
        match options.known_token {
            true => format!("http://{}/", options.address),
            false => format!("http://{}/#token={}", options.address, options.token),
        }
    }

    /// Serves until the task ends.
    pub async fn serve(self) {
        admission::serve(self.listener, router(self.http)).await;
    }
}

fn router(http: Arc<Http>) -> Router {
    let pages = page::FILES.iter().fold(Router::new(), |router, file| {
        router.route(file.path, get(move || async move { file.response() }))
    });
    Router::new()
        .route("/", get(foxglove::index))
        .route("/metrics", get(metrics))
        .route(
            "/openapi.json",
            get(|| async { axum::Json(openapi::document()) }),
        )
        .route("/api/ws", get(websocket::upgrade))
        .route(
            "/api/machine",
            get(machine)
                .post(|state, headers, body| operation(state, path_of("machine"), headers, body)),
        )
        .route(
            "/api/state",
            get(state)
                .post(|state, headers, body| operation(state, path_of("state"), headers, body)),
        )
        .route(
            "/api/events",
            get(events)
                .post(|state, headers, body| operation(state, path_of("events"), headers, body)),
        )
        .route("/api/samples", get(samples))
        .route("/api/history", get(history))
        .route("/api/histogram", get(histogram))
        .route("/api/export.csv", get(export_csv))
        .route("/api/export.mcap", get(export_mcap))
        .route("/api/recordings", get(recordings))
        .route("/api/recordings/{name}", get(recording))
        .route("/api/{op}", post(operation))
        .merge(pages)
        .layer(DefaultBodyLimit::max(LINE))
        .layer(middleware::from_fn_with_state(Arc::clone(&http), guard))
        .with_state(http)
}

impl Http {
    pub(crate) fn is_loopback(&self) -> bool {
        self.options.address.ip().is_loopback()
    }

    fn client(&self, headers: &HeaderMap) -> &Client {
        match self.tokens.rights_of(headers) {
            Some(Rights::Command) => &self.commanding,
            Some(Rights::Read) => &self.reading,
            None => &self.without_token,
        }
    }

    /// Returns whether a `Host` header names this server. Otherwise, a page of another server could
    /// reach it under a name of its own (DNS rebinding).
    fn is_own_host(&self, host: &str) -> bool {
        let bracket = host.rfind(']').map_or(0, |at| at + 1);
        let name = match host[bracket..].rfind(':') {
            Some(colon) => &host[..bracket + colon],
            None => host,
        };
        let bare = name.trim_start_matches('[').trim_end_matches(']');
        let own = match bare.parse::<IpAddr>() {
            Ok(_) => true,
            Err(_) => name.eq_ignore_ascii_case("localhost"),
        };
        own || self
            .options
            .hosts
            .iter()
            .any(|host| host.eq_ignore_ascii_case(name))
    }

    /// Fails if a page of another server asks, or under a foreign name. A viewer of another server
    /// with the token may connect, because it only reads.
    ///
    /// A link to the page may stand anywhere.
    fn check_origin(&self, method: &Method, headers: &HeaderMap, to: &Uri) -> Result<(), OpError> {
        let wrong = |message| OpError::new(ErrorCode::WrongOrigin, message);
        let host = match once(headers, &header::HOST) {
            Ok(Some(host)) if self.is_own_host(host) => host,
            _ => {
                let error = wrong("the `Host` is not this server");
                return Err(error.help("name it with --allow-host"));
            }
        };
        let own = match once(headers, &header::ORIGIN) {
            Ok(None) => true,
            Ok(Some(origin)) => origin.strip_prefix("http://") == Some(host),
            Err(_) => false,
        };
        // Browsers say from where a request comes, also if it has no `Origin`.
        let site = once(headers, &HeaderName::from_static("sec-fetch-site"));
        let same_site = matches!(site, Ok(None | Some("same-origin" | "none")));
        let is = |name, value| once(headers, &HeaderName::from_static(name)) == Ok(Some(value));
        let link = method == Method::GET
            && to.path() == "/"
            && is("sec-fetch-mode", "navigate")
            && is("sec-fetch-dest", "document");
        let viewer = foxglove::is_asked_for(headers, to) && self.tokens.are_in(to);
        match own && (same_site || link) || viewer {
            true => Ok(()),
            false => Err(wrong("the page is of another server")),
        }
    }
}

/// Returns the value of a header that may occur once.
fn once<'h>(headers: &'h HeaderMap, name: &HeaderName) -> Result<Option<&'h str>, ()> {
    let mut values = headers.get_all(name).iter();
    let value = values.next().map(HeaderValue::to_str);
    match values.next() {
        Some(_) => Err(()),
        None => value.transpose().map_err(|_| ()),
    }
}

/// Refuses foreign pages, and adds the headers that every answer has.
async fn guard(State(http): Shared, request: HttpRequest, next: Next) -> Response {
    let own = http.check_origin(request.method(), request.headers(), request.uri());
    let mut response = match own {
        Ok(()) => next.run(request).await,
        Err(error) => refusal(&error),
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (
            header::CONTENT_SECURITY_POLICY,
            "default-src 'self'; frame-ancestors 'none'",
        ),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-store"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

pub(crate) fn refusal(error: &OpError) -> Response {
    let mut response = respond(error.answer(), error.code.status());
    if response.status() == StatusCode::TOO_MANY_REQUESTS {
        let second = HeaderValue::from_static("1");
        response.headers_mut().insert(header::RETRY_AFTER, second);
    }
    response
}

fn respond(body: Map<String, Value>, status: u16) -> Response {
    let status = StatusCode::from_u16(status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
    (status, axum::Json(Value::Object(body))).into_response()
}

/// Returns the operation of a path that answers GET as well.
fn path_of(op: &str) -> Path<String> {
    Path(op.to_owned())
}

async fn operation(
    State(http): Shared,
    Path(op): Path<String>,
    headers: HeaderMap,
    body: Body,
) -> Response {
    let body = match read_body(body).await {
        Ok(body) => body,
        Err(error) => return refusal(&error),
    };
    let parsed = match body.is_empty() {
        true => Ok(Value::Object(Map::new())),
        false => strict::from_slice(&body),
    };
    let mut map = match parsed {
        Ok(Value::Object(map)) => map,
        Ok(_) => {
            return refusal(&OpError::new(
                ErrorCode::BadRequest,
                "the body is not an object",
            ));
        }
        Err(error) => {
            return refusal(&OpError::new(
                ErrorCode::BadRequest,
                format!("not JSON: {error}"),
            ));
        }
    };
    map.insert("op".to_owned(), Value::String(op));
    read(&http, &headers, map).await
}

/// Reads a body of at most [`LINE`] bytes. A client that does not send it keeps no place.
async fn read_body(body: Body) -> Result<Bytes, OpError> {
    let whole = tokio::time::timeout(BODY, axum::body::to_bytes(body, LINE)).await;
    match whole {
        Ok(Ok(bytes)) => Ok(bytes),
        Ok(Err(_)) => {
            let message = "the body is longer than 64 KiB, or not whole";
            Err(OpError::new(ErrorCode::TooLarge, message))
        }
        Err(_) => Err(OpError::new(ErrorCode::Timeout, "the body did not come")),
    }
}

/// Carries out an operation without a body.
async fn read(http: &Http, headers: &HeaderMap, op: Map<String, Value>) -> Response {
    let request = Request::from_object(op);
    let Answer { body, status, .. } = http.client(headers).answer(request).await;
    respond(body, status)
}

fn named(op: &str) -> Map<String, Value> {
    Map::from_iter([("op".to_owned(), json!(op))])
}

async fn machine(State(http): Shared, headers: HeaderMap) -> Response {
    read(&http, &headers, named("machine")).await
}

async fn state(State(http): Shared, headers: HeaderMap) -> Response {
    read(&http, &headers, named("state")).await
}

#[derive(Debug, Deserialize)]
struct After {
    #[serde(default)]
    after: u64,
}

async fn events(
    State(http): Shared,
    headers: HeaderMap,
    Query(After { after }): Query<After>,
) -> Response {
    let mut op = named("events");
    op.insert("after".to_owned(), json!(after));
    read(&http, &headers, op).await
}

/// Signals and a range of samples, as in the query of a URL.
#[derive(Debug, Deserialize)]
struct Range {
    /// Names with commas between; all without it.
    signals: Option<String>,
    first: Option<u64>,
    count: Option<u64>,
    from_ns: Option<u64>,
    to_ns: Option<u64>,
    buckets: Option<usize>,
}

impl Range {
    fn names(&self) -> Option<Vec<String>> {
        let names = self.signals.as_ref()?;
        Some(names.split(',').map(str::to_owned).collect())
    }

    fn words(&self, http: &Http, headers: &HeaderMap) -> Result<Vec<usize>, OpError> {
        http.client(headers).check_read()?;
        let names = self.names();
        let mut seen = HashSet::new();
        let mut all = names.iter().flatten();
        if let Some(twice) = all.find(|name| !seen.insert(name.as_str())) {
            // Not of a signal: any text may be a name.
            let message = format!("the signal {twice:?} is named twice");
            return Err(OpError::new(ErrorCode::BadRequest, message));
        }
        signal_words(&http.hub.samples, names.as_deref())
    }
}

/// Answers with the bytes that `make` returns, made apart from the threads that serve clients.
async fn binary(http: &Arc<Http>, make: impl FnOnce(&Hub) -> Vec<u8> + Send + 'static) -> Response {
    let hub = Arc::clone(&http.hub);
    match http.bulk.bytes(move || make(&hub)).await {
        Ok(bytes) => {
            let kind = [(header::CONTENT_TYPE, "application/octet-stream")];
            (kind, bytes).into_response()
        }
        Err(error) => refusal(&error),
    }
}

async fn samples(State(http): Shared, headers: HeaderMap, Query(range): Query<Range>) -> Response {
    let words = match range.words(&http, &headers) {
        Ok(words) => words,
        Err(error) => return refusal(&error),
    };
    let most = (VALUES / words.len().max(1)).max(1) as u64;
    let count = range.count.unwrap_or(1000).min(most);
    binary(&http, move |hub| {
        let samples = &hub.samples;
        let newest = samples.written().saturating_sub(count);
        let mut next = range.first.unwrap_or(newest);
        Batch::read(samples, &words, &mut next, count).frame()
    })
    .await
}

async fn history(State(http): Shared, headers: HeaderMap, Query(range): Query<Range>) -> Response {
    let words = match range.words(&http, &headers) {
        Ok(words) => words,
        Err(error) => return refusal(&error),
    };
    // A bucket has two values of each signal.
    let most = (VALUES / 2 / words.len().max(1)).clamp(1, BUCKETS);
    let buckets = range.buckets.unwrap_or(1000).clamp(1, most);
    let times = [
        range.from_ns.unwrap_or(0),
        range.to_ns.unwrap_or(u64::MAX - 1),
    ];
    binary(&http, move |hub| {
        let history = hub.sampler.history(&hub.samples, &words, times, buckets);
        history.frame()
    })
    .await
}

async fn histogram(State(http): Shared, headers: HeaderMap) -> Response {
    if let Err(error) = http.client(&headers).check_read() {
        return refusal(&error);
    }
    let hub = Arc::clone(&http.hub);
    let make = move || serde_json::to_vec(&hub.sampler.histogram_object()).unwrap_or_default();
    match http.bulk.bytes(make).await {
        Ok(text) => ([(header::CONTENT_TYPE, "application/json")], text).into_response(),
        Err(error) => refusal(&error),
    }
}

async fn metrics(State(http): Shared, headers: HeaderMap) -> Response {
    if let Err(error) = http.client(&headers).check_read() {
        return refusal(&error);
    }
    let hub = Arc::clone(&http.hub);
    let make = move || crate::metrics::text(&hub).into_bytes();
    match http.bulk.bytes(make).await {
        Ok(text) => {
            let kind = "text/plain; version=0.0.4; charset=utf-8";
            ([(header::CONTENT_TYPE, kind)], text).into_response()
        }
        Err(error) => refusal(&error),
    }
}

fn download(name: &str, kind: &'static str, body: Body) -> Response {
    let disposition = format!("attachment; filename=\"{name}\"");
    let headers = [
        (header::CONTENT_TYPE, kind.to_owned()),
        (header::CONTENT_DISPOSITION, disposition),
    ];
    (headers, body).into_response()
}

/// Writes a file of the words of rows between two times.
type Export = fn(Pieces, &Hub, &[usize], [u64; 2]) -> io::Result<Pieces>;

async fn export_csv(
    State(http): Shared,
    headers: HeaderMap,
    Query(range): Query<Range>,
) -> Response {
    let kind = "text/csv; charset=utf-8";
    let make: Export = |mut out, hub, words, times| {
        export::csv(&mut out, &hub.samples, words, times)?;
        Ok(out)
    };
    export(&http, &headers, &range, "csv", kind, make).await
}

async fn export_mcap(
    State(http): Shared,
    headers: HeaderMap,
    Query(range): Query<Range>,
) -> Response {
    let kind = "application/octet-stream";
    let make: Export =
        |out, hub, words, times| export::mcap(out, &hub.samples, &hub.topics, words, times);
    export(&http, &headers, &range, "mcap", kind, make).await
}

async fn export(
    http: &Arc<Http>,
    headers: &HeaderMap,
    range: &Range,
    extension: &str,
    kind: &'static str,
    make: Export,
) -> Response {
    let words = match range.words(http, headers) {
        Ok(words) => words,
        Err(error) => return refusal(&error),
    };
    let times = [range.from_ns.unwrap_or(0), range.to_ns.unwrap_or(u64::MAX)];
    let hub = Arc::clone(&http.hub);
    let name = hub.machine.path.file_stem().unwrap_or_default();
    let plain = |c: &char| c.is_ascii_alphanumeric() || *c == '-' || *c == '_';
    let name: String = name.to_string_lossy().chars().filter(plain).collect();
    match http
        .bulk
        .body(move |out| make(out, &hub, &words, times))
        .await
    {
        Ok(body) => download(&format!("{name}.{extension}"), kind, body),
        Err(error) => refusal(&error),
    }
}

/// Returns whether a file is a recording: not a link, nor a second name of a file elsewhere.
fn is_recording(about: &Metadata) -> bool {
    about.is_file() && about.nlink() == 1
}

async fn recordings(State(http): Shared, headers: HeaderMap) -> Response {
    if let Err(error) = http.client(&headers).check_read() {
        return refusal(&error);
    }
    let folder = http.options.recordings.clone();
    let list = tokio::task::spawn_blocking(move || {
        let folder = folder?;
        let entries = std::fs::read_dir(folder).ok()?;
        let mut files: Vec<Value> = entries
            .filter_map(|entry| {
                let entry = entry.ok()?;
                let about = entry.metadata().ok()?;
                let name = entry.file_name().into_string().ok()?;
                let modified = about.modified().ok()?;
                let modified = modified.duration_since(std::time::UNIX_EPOCH).ok()?;
                is_recording(&about).then(|| {
                    json!({"name": name, "bytes": about.len(), "modified_s": modified.as_secs()})
                })
            })
            .collect();
        files.sort_by_key(|file| std::cmp::Reverse(file["modified_s"].as_u64()));
        Some(files)
    });
    let list = list.await.ok().flatten().unwrap_or_default();
    axum::Json(json!({"recordings": list})).into_response()
}

async fn recording(State(http): Shared, headers: HeaderMap, Path(name): Path<String>) -> Response {
    if let Err(error) = http.client(&headers).check_read() {
        return refusal(&error);
    }
    let unknown = || OpError::new(ErrorCode::UnknownName, format!("no recording `{name}`"));
    let plain = !name.contains(['/', '\\', '\0']) && !name.starts_with('.');
    let Some(folder) = http.options.recordings.as_ref().filter(|_| plain) else {
        return refusal(&unknown());
    };
    let path = folder.join(&name);
    let open = move || {
        // The file that is read is the one that was judged.
        let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
        let mut options = File::options();
        let options = options.read(true).custom_flags(flags.bits().cast_signed());
        let file = options.open(&path).ok()?;
        file.metadata().ok().filter(is_recording).map(|_| file)
    };
    let opened = tokio::task::spawn_blocking(open).await;
    match opened.ok().flatten() {
        Some(file) => download(
            &name.replace('"', ""),
            "application/octet-stream",
            Body::from_stream(pieces(file)),
        ),
        None => refusal(&unknown()),
    }
}

/// Returns the content of a file in pieces: a recording may be larger than the memory.
fn pieces(file: File) -> impl futures_util::Stream<Item = io::Result<Vec<u8>>> {
    futures_util::stream::try_unfold(file, |mut file| async move {
        let read = move || {
            let mut piece = vec![0; PIECE];
            let count = file.read(&mut piece)?;
            piece.truncate(count);
            Ok((count > 0).then_some((piece, file)))
        };
        tokio::task::spawn_blocking(read)
            .await
            .map_err(io::Error::other)?
    })
}
