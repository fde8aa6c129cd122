//! The fleet page: a tile per machine, which links to the machine's own page. It only reads.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::{Request, State};
use axum::http::{StatusCode, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use tokio::net::TcpListener;
use tokio::sync::Mutex;
use zenoh::Session;

use crate::error::{Error, Result};
use crate::keys::MachineId;
use crate::observe::status::Seen;
use crate::observe::{print, status};
use crate::options::{Network, PageOptions};
use crate::session;

/// The age at which the picture is queried again, however many browsers ask.
const MAX_AGE: Duration = Duration::from_millis(900);

/// A vanished machine stays on the page only while there are fewer machines.
const MAX_MACHINES: usize = 10_000;

/// Path, kind and content of the files. Style, icon and helpers are those of the server's page.
const FILES: [(&str, &str, &str); 6] = [
    (
        "/",
        "text/html; charset=utf-8",
        include_str!("../page/index.html"),
    ),
    (
        "/fleet.css",
        "text/css; charset=utf-8",
        include_str!("../page/fleet.css"),
    ),
    (
        "/fleet.js",
        "text/javascript; charset=utf-8",
        include_str!("../page/fleet.js"),
    ),
    (
        "/style.css",
        "text/css; charset=utf-8",
        include_str!("../../server/page/style.css"),
    ),
    (
        "/dom.js",
        "text/javascript; charset=utf-8",
        include_str!("../../server/page/dom.js"),
    ),
    (
        "/icon.svg",
        "image/svg+xml",
        include_str!("../../server/page/icon.svg"),
    ),
];

#[derive(Debug)]
struct Page {
    session: Session,
    allowed_hosts: Vec<String>,
    picture: Mutex<Picture>,
}

/// What the browsers are shown.
#[derive(Debug, Default)]
struct Picture {
    /// The instant of the last query.
    at: Option<Instant>,
    /// All machines since the start of the page.
    machines: BTreeMap<MachineId, Seen>,
    /// The same as JSON.
    text: String,
}

/// Adds the machines that have vanished to those of a query.
fn with_vanished(
    before: &BTreeMap<MachineId, Seen>,
    mut now: BTreeMap<MachineId, Seen>,
) -> BTreeMap<MachineId, Seen> {
    for (id, seen) in before {
        if now.len() < MAX_MACHINES && !now.contains_key(id) {
            let mut gone = seen.clone();
            gone.alive = false;
            gone.set_age();
            now.insert(id.clone(), gone);
        }
    }
    now
}

/// Serves the page until SIGINT or SIGTERM.
///
/// # Errors
/// Fails if no router is reached or the address is not free.
pub async fn run(network: &Network, options: PageOptions) -> Result<()> {
    let session = session::open_observer(network).await?;
    let page = Arc::new(Page {
        session,
        allowed_hosts: options.allow_host,
        picture: Mutex::default(),
    });
    let at = |error: std::io::Error| Error::new(format!("{}: {error}", options.http));
    let listener = TcpListener::bind(options.http).await.map_err(at)?;
    let address = listener.local_addr().map_err(at)?;
    print(&format!("http://{address}/"))?;
    let stopped = async { drop(session::terminated().await) };
    let served = axum::serve(listener, router(page)).with_graceful_shutdown(stopped);
    served.await.map_err(at)
}

fn router(page: Arc<Page>) -> Router {
    let mut router = Router::new().route("/api/fleet", get(fleet));
    for (path, kind, content) in FILES {
        router = router.route(
            path,
            get(move || async move { ([(header::CONTENT_TYPE, kind)], content) }),
        );
    }
    router
        .layer(from_fn_with_state(Arc::clone(&page), guard))
        .with_state(page)
}

/// Refuses other names of this computer: the page of another site reads nothing through them.
async fn guard(State(page): State<Arc<Page>>, request: Request, next: Next) -> Response {
    let host = request
        .headers()
        .get(header::HOST)
        .and_then(|host| host.to_str().ok());
    if !host.is_some_and(|host| is_allowed(host, &page.allowed_hosts)) {
        return (StatusCode::FORBIDDEN, "unknown host: use --allow-host").into_response();
    }
    let mut response = next.run(request).await;
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
        headers.insert(name, header::HeaderValue::from_static(value));
    }
    response
}

/// Returns true for an address, `localhost` or a name of the command line.
fn is_allowed(host: &str, allowed: &[String]) -> bool {
    let bare = host.trim_start_matches('[').trim_end_matches(']');
    if host.parse::<SocketAddr>().is_ok() || bare.parse::<IpAddr>().is_ok() {
        return true;
    }
    let name = host.rsplit_once(':').map_or(host, |(name, _)| name);
    let is_name = |known: &str| known.eq_ignore_ascii_case(name);
    is_name("localhost") || allowed.iter().any(|allowed| is_name(allowed))
}

async fn fleet(State(page): State<Arc<Page>>) -> Response {
    let mut picture = page.picture.lock().await;
    if picture.at.is_none_or(|at| at.elapsed() >= MAX_AGE) {
        let machines = match status::look(&page.session).await {
            Ok(machines) => with_vanished(&picture.machines, machines),
            Err(error) => return (StatusCode::BAD_GATEWAY, error.to_string()).into_response(),
        };
        *picture = Picture {
            at: Some(Instant::now()),
            text: status::to_json(&machines).to_string(),
            machines,
        };
    }
    (
        [(header::CONTENT_TYPE, "application/json")],
        picture.text.clone(),
    )
        .into_response()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vanished_machines_stay_on_the_page() {
        let id = |name: &str| {
            let key = format!("ecaxis/hall/{name}/alive");
            MachineId::of_key(&key).unwrap().0
        };
        let there = || Seen {
            alive: true,
            ..Seen::default()
        };
        let before = BTreeMap::from([(id("m1"), there()), (id("m2"), there())]);
        let now = with_vanished(&before, BTreeMap::from([(id("m2"), there())]));
        let alive: Vec<_> = now.iter().map(|(id, seen)| (id, seen.alive)).collect();
        assert_eq!(alive, [(&id("m1"), false), (&id("m2"), true)]);
        let now = with_vanished(&now, BTreeMap::from([(id("m1"), there())]));
        assert!(now[&id("m1")].alive && !now[&id("m2")].alive);
    }

    #[test]
    fn other_names_of_this_computer_are_refused() {
        let allowed = ["hall.example".to_owned()];
        for host in [
            "127.0.0.1:8090",
            "[::1]:8090",
            "[::1]",
            "10.0.0.1",
            "localhost:8090",
            "Hall.example",
        ] {
            assert!(is_allowed(host, &allowed), "{host}");
        }
        for host in [
            "",
            "attacker.example",
            "127.0.0.1.attacker.example:8090",
            "localhost.example",
        ] {
            assert!(!is_allowed(host, &allowed), "{host}");
        }
    }

    #[test]
    fn the_page_names_files_that_exist() {
        let (_, _, index) = FILES[0];
        let named = index
            .split('"')
            .filter(|text| text.ends_with(".js") || text.ends_with(".css"));
        for name in named {
            let found = FILES
                .iter()
                .any(|(path, ..)| path.strip_prefix('/') == Some(name));
            assert!(found, "{name}");
        }
    }
}
