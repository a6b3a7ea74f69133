//! All paths of the interface, and what every request passes on its way.

use super::guard::Peer;
use super::problem::Problem;
use super::shared::{Shared, State};
use super::{
    jobs, live_events, live_groups, live_mesh, live_picture, metrics, pages, replay, reports, scanner, sessions,
};
use axum::Router;
use axum::extract::Request;
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, delete, get, patch, post};
use std::sync::Arc;
use std::time::Instant;
use tracing::Instrument;

/// Where the interface begins.
pub const PREFIX: &str = "/api/v1";

/// Every path and its methods; the description in openapi.json is held against this.
pub struct Routes {
    router: Router<Arc<Shared>>,
    /// Method and path, as openapi.json writes them.
    pub table: Vec<(&'static str, String)>,
}

impl Routes {
    fn add(mut self, methods: &[&'static str], path: &str, route: MethodRouter<Arc<Shared>>) -> Self {
        self.table.extend(methods.iter().map(|m| (*m, path.to_owned())));
        self.router = self.router.route(path, route);
        self
    }

    fn api(self, methods: &[&'static str], path: &str, route: MethodRouter<Arc<Shared>>) -> Self {
        self.add(methods, &format!("{PREFIX}{path}"), route)
    }
}

/// The table of paths.
pub fn routes() -> Routes {
    let routes = Routes { router: Router::new(), table: Vec::new() };
    session_routes(stream_routes(scanner_routes(routes)))
        .api(&["get"], "/jobs", get(jobs::list))
        .api(&["get", "delete"], "/jobs/{id}", get(jobs::one).merge(delete(jobs::cancel)))
        .api(&["get"], "/jobs/{id}/result", get(jobs::result))
        .api(&["get"], "/reports", get(reports::list))
        .api(&["get"], "/reports/{name}", get(reports::one))
}

fn scanner_routes(routes: Routes) -> Routes {
    routes
        .add(&["get"], "/healthz", get(metrics::health))
        .add(&["get"], "/metrics", get(metrics::metrics))
        .api(&["get"], "/openapi.json", get(openapi))
        .api(&["post"], "/login", post(scanner::login))
        .api(&["get"], "/status", get(scanner::status))
        .api(&["post"], "/scanner/start", post(scanner::start))
        .api(&["post"], "/scanner/stop", post(scanner::stop))
        .api(&["post"], "/recording/start", post(scanner::start_recording))
        .api(&["post"], "/recording/stop", post(scanner::stop_recording))
        .api(&["post"], "/recording/mark", post(scanner::mark))
        .api(&["post"], "/config/reload", post(scanner::reload))
        .api(&["get"], "/devices", get(scanner::devices))
        .api(&["post"], "/doctor", post(scanner::doctor))
}

fn stream_routes(routes: Routes) -> Routes {
    routes
        .api(&["get"], "/live/events", get(live_events::upgrade))
        .api(&["get"], "/live/picture", get(live_picture::upgrade))
        .api(&["get"], "/live/mesh", get(live_mesh::upgrade))
        .api(&["get"], "/live/groups", get(live_groups::upgrade))
        .api(&["get"], "/sessions/{name}/replay", get(replay::upgrade))
}

fn session_routes(routes: Routes) -> Routes {
    let one = get(sessions::one).merge(patch(sessions::rename)).merge(delete(sessions::remove));
    routes
        .api(&["get"], "/sessions", get(sessions::list))
        .api(&["get", "patch", "delete"], "/sessions/{name}", one)
        .api(&["get"], "/sessions/{name}/file", get(sessions::file))
        .api(&["get"], "/sessions/{name}/thumbnail.png", get(sessions::thumbnail))
        .api(&["get"], "/sessions/{name}/curve", get(sessions::curve))
        .api(&["post"], "/sessions/{name}/verify", post(jobs::verify))
        .api(&["post"], "/sessions/{name}/recover", post(jobs::recover))
        .api(&["post"], "/sessions/{name}/export", post(jobs::export))
        .api(&["post"], "/sessions/{name}/compare", post(jobs::compare))
}

/// The whole service.
pub fn app(shared: &Arc<Shared>) -> Router {
    let router = routes().router.fallback(fallback).method_not_allowed_fallback(|| async {
        Problem::new(StatusCode::METHOD_NOT_ALLOWED, "this path has other methods; see /api/v1/openapi.json")
    });
    router.layer(from_fn_with_state(Arc::clone(shared), pass)).with_state(Arc::clone(shared))
}

async fn openapi() -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/json")], include_str!("openapi.json"))
}

async fn fallback(request: Request) -> Response {
    let path = request.uri().path();
    if path.starts_with("/api/") {
        return Problem::not_found("no such path; see /api/v1/openapi.json").into_response();
    }
    pages::respond(request.method(), path, request.headers())
}

/// Span, checks, counters, and the fields that every answer has.
async fn pass(axum::extract::State(shared): State, request: Request, next: Next) -> Response {
    let begun = Instant::now();
    let (method, path) = (request.method().clone(), request.uri().path().to_owned());
    let Some(&Peer(peer)) = request.extensions().get::<Peer>() else {
        return Problem::internal("a request without an address").into_response();
    };
    let span = tracing::info_span!("request", %method, path, %peer);
    let mut response = match shared.guard.check(&method, &path, request.headers(), peer.ip()) {
        Ok(()) => next.run(request).instrument(span.clone()).await,
        Err(problem) => problem.into_response(),
    };
    let status = response.status();
    let class = usize::from(status.as_u16() / 100).clamp(1, 5) - 1;
    shared.counters.answers[class].add();
    let ms = begun.elapsed().as_secs_f64() * 1e3;
    span.in_scope(|| {
        if method.is_safe() && !status.is_server_error() {
            tracing::debug!(status = status.as_u16(), ms, "answered");
        } else {
            tracing::info!(status = status.as_u16(), ms, "answered");
        }
    });
    let fields = response.headers_mut();
    fields.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    fields.insert(header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    fields.insert("cross-origin-resource-policy", HeaderValue::from_static("same-origin"));
    if !fields.contains_key(header::CACHE_CONTROL) {
        fields.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    }
    response
}
