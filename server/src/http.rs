//! HTTP and WebSocket: the page, the operations, samples, history and metrics.

use std::io::Read as _;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{DefaultBodyLimit, Path, Query, Request as HttpRequest, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, Uri, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use serde::Deserialize;
use serde_json::{Map, Value, json};
use tokio::net::TcpListener;

use crate::client::{Answer, Client};
use crate::command::Request;
use crate::connection::{Batch, same, signal_words};
use crate::error::{ErrorCode, OpError};
use crate::export;
use crate::foxglove::{self, Viewers};
use crate::hub::Hub;
use crate::openapi;
use crate::page;
use crate::socket::LINE;
use crate::websocket;

/// The most buckets of one history.
const BUCKETS: usize = 20_000;
/// The most values of one answer.
const VALUES: u64 = 1 << 22;
/// The bytes of a recording that are read at once.
const PIECE: usize = 256 * 1024;

/// Settings of the HTTP server.
#[derive(Debug, Clone)]
pub struct HttpOptions {
    pub address: SocketAddr,
    /// Clients with the token may command.
    pub control: bool,
    pub token: String,
    /// Further names that the `Host` header may contain.
    pub hosts: Vec<String>,
    pub recordings: Option<PathBuf>,
}

/// What every handler needs.
#[derive(Debug)]
pub struct Http {
    pub hub: Arc<Hub>,
    pub(crate) viewers: Viewers,
    pub(crate) options: HttpOptions,
    pub(crate) token: Arc<str>,
    /// The client of all requests with the token, and of those without.
    with_token: Client,
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
    pub async fn bind(hub: &Arc<Hub>, mut options: HttpOptions) -> std::io::Result<Self> {
        let listener = TcpListener::bind(options.address).await?;
        options.address = listener.local_addr()?;
        let no_token = OpError::new(ErrorCode::NoToken, "this needs the token")
            .help("use the address that the server printed");
        let control = options.control;
        let read_only = (!control).then(read_only);
        let http = Http {
            with_token: Client::new(Arc::clone(hub), "http", read_only, true),
            without_token: Client::new(Arc::clone(hub), "http", Some(no_token), true),
            token: options.token.clone().into(),
            hub: Arc::clone(hub),
            viewers: Viewers::new(),
            options,
        };
        http.without_token.set_blind(!http.is_loopback());
        Ok(Self {
            listener,
            http: Arc::new(http),
        })
    }

    /// Returns the address with the token.
    #[must_use]
    pub fn url(&self) -> String {
        let Http { options, .. } = &*self.http;
        format!("http://{}/#token={}", options.address, options.token)
    }

    /// Serves until the task ends.
    ///
    /// # Errors
    /// Fails if the system refuses to accept clients.
    pub async fn serve(self) -> std::io::Result<()> {
        axum::serve(self.listener, router(self.http)).await
    }
}

pub(crate) fn read_only() -> OpError {
    OpError::new(
        ErrorCode::ReadOnly,
        "the server takes no commands over HTTP",
    )
    .help("start it with --control")
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
        .route("/api/machine", get(machine))
        .route("/api/state", get(state))
        .route("/api/events", get(events))
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

    pub(crate) fn has_token(&self, headers: &HeaderMap) -> bool {
        let given = headers.get(header::AUTHORIZATION);
        let given = given.and_then(|value| value.to_str().ok());
        let given = given.and_then(|value| value.strip_prefix("Bearer "));
        given.is_some_and(|given| same(&self.token, given.trim()))
    }

    /// Returns whether the address contains the token, as `?token=TOKEN`: viewers in a browser
    /// cannot set headers.
    pub(crate) fn has_token_in(&self, address: &Uri) -> bool {
        let mut keys = address.query().unwrap_or_default().split('&');
        keys.any(|key| {
            key.strip_prefix("token=")
                .is_some_and(|given| same(&self.token, given))
        })
    }

    fn client(&self, headers: &HeaderMap) -> &Client {
        match self.has_token(headers) {
            true => &self.with_token,
            false => &self.without_token,
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
    fn check_origin(&self, headers: &HeaderMap, address: &Uri) -> Result<(), OpError> {
        let text = |name| headers.get(name).map(|value: &HeaderValue| value.to_str());
        let host = match text(header::HOST) {
            Some(Ok(host)) if self.is_own_host(host) => host,
            _ => {
                let error = OpError::new(ErrorCode::WrongOrigin, "the `Host` is not this server");
                return Err(error.help("name it with --allow-host"));
            }
        };
        let own = match text(header::ORIGIN) {
            None => true,
            Some(Ok(origin)) => origin.strip_prefix("http://") == Some(host),
            Some(Err(_)) => false,
        };
        let viewer = foxglove::is_asked_for(headers, address) && self.has_token_in(address);
        (own || viewer)
            .then_some(())
            .ok_or_else(|| OpError::new(ErrorCode::WrongOrigin, "the page is of another server"))
    }
}

/// Refuses foreign pages, and adds the headers that every answer has.
async fn guard(State(http): Shared, request: HttpRequest, next: Next) -> Response {
    let mut response = match http.check_origin(request.headers(), request.uri()) {
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
    respond(error.answer(), error.code.status())
}

fn respond(body: Map<String, Value>, status: u16) -> Response {
    let status = StatusCode::from_u16(status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
    (status, axum::Json(Value::Object(body))).into_response()
}

async fn operation(
    State(http): Shared,
    Path(op): Path<String>,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    let parsed = match body.is_empty() {
        true => Ok(Value::Object(Map::new())),
        false => serde_json::from_slice(&body),
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
        signal_words(&http.hub.samples, self.names().as_deref())
    }
}

fn binary(bytes: Vec<u8>) -> Response {
    let kind = [(header::CONTENT_TYPE, "application/octet-stream")];
    (kind, bytes).into_response()
}

async fn samples(State(http): Shared, headers: HeaderMap, Query(range): Query<Range>) -> Response {
    let words = match range.words(&http, &headers) {
        Ok(words) => words,
        Err(error) => return refusal(&error),
    };
    let samples = &http.hub.samples;
    let most = (VALUES / words.len().max(1) as u64).max(1);
    let count = range.count.unwrap_or(1000).min(most);
    let newest = samples.written().saturating_sub(count);
    let mut next = range.first.unwrap_or(newest);
    binary(Batch::read(samples, &words, &mut next, count).frame())
}

async fn history(State(http): Shared, headers: HeaderMap, Query(range): Query<Range>) -> Response {
    let words = match range.words(&http, &headers) {
        Ok(words) => words,
        Err(error) => return refusal(&error),
    };
    let buckets = range.buckets.unwrap_or(1000).clamp(1, BUCKETS);
    let times = [
        range.from_ns.unwrap_or(0),
        range.to_ns.unwrap_or(u64::MAX - 1),
    ];
    let hub = Arc::clone(&http.hub);
    // An hour of many signals takes a while; other clients do not wait for it.
    let work = move || hub.sampler.history(&hub.samples, &words, times, buckets);
    match tokio::task::spawn_blocking(work).await {
        Ok(history) => binary(history.frame()),
        Err(error) => refusal(&OpError::new(ErrorCode::Failed, error.to_string())),
    }
}

async fn histogram(State(http): Shared, headers: HeaderMap) -> Response {
    match http.client(&headers).check_read() {
        Ok(()) => axum::Json(http.hub.sampler.histogram_object()).into_response(),
        Err(error) => refusal(&error),
    }
}

async fn metrics(State(http): Shared, headers: HeaderMap) -> Response {
    match http.client(&headers).check_read() {
        Ok(()) => {
            let kind = "text/plain; version=0.0.4; charset=utf-8";
            let kind = [(header::CONTENT_TYPE, kind)];
            (kind, crate::metrics::text(&http.hub)).into_response()
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

/// Makes a file of the words of rows between two times.
type Export = fn(&Hub, &[usize], [u64; 2]) -> Result<Vec<u8>, OpError>;

async fn export_csv(
    State(http): Shared,
    headers: HeaderMap,
    Query(range): Query<Range>,
) -> Response {
    let kind = "text/csv; charset=utf-8";
    export(&http, &headers, &range, "csv", kind, |hub, words, times| {
        let rows = export::Rows::read(&hub.samples, words, times)?;
        Ok(export::csv(&rows).into_bytes())
    })
    .await
}

async fn export_mcap(
    State(http): Shared,
    headers: HeaderMap,
    Query(range): Query<Range>,
) -> Response {
    let kind = "application/octet-stream";
    export(
        &http,
        &headers,
        &range,
        "mcap",
        kind,
        |hub, words, times| export::mcap(&hub.samples, &hub.topics, words, times),
    )
    .await
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
    match tokio::task::spawn_blocking(move || make(&hub, &words, times)).await {
        Ok(Ok(bytes)) => download(&format!("{name}.{extension}"), kind, Body::from(bytes)),
        Ok(Err(error)) => refusal(&error),
        Err(error) => refusal(&OpError::new(ErrorCode::Failed, error.to_string())),
    }
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
                about.is_file().then(|| {
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
        let about = std::fs::symlink_metadata(&path).ok()?;
        about.is_file().then(|| std::fs::File::open(&path).ok())?
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
fn pieces(file: std::fs::File) -> impl futures_util::Stream<Item = std::io::Result<Vec<u8>>> {
    futures_util::stream::try_unfold(file, |mut file| async move {
        let read = move || {
            let mut piece = vec![0; PIECE];
            let count = file.read(&mut piece)?;
            piece.truncate(count);
            Ok((count > 0).then_some((piece, file)))
        };
        tokio::task::spawn_blocking(read)
            .await
            .map_err(std::io::Error::other)?
    })
}
