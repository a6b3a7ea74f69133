//! openapi.json against the routes, and answers against its schemas.

use super::harness::Running;
use crate::server::routes::routes;
use serde_json::Value;
use std::collections::BTreeSet;

fn description() -> Value {
    serde_json::from_str(include_str!("../openapi.json")).unwrap()
}

/// Checks a value against the keywords of JSON Schema that openapi.json uses; others are an error.
fn check(document: &Value, schema: &Value, value: &Value, at: &str) -> Result<(), String> {
    for (keyword, rule) in schema.as_object().ok_or(format!("{at}: no schema"))? {
        let holds = match keyword.as_str() {
            "description" => true,
            "$ref" => {
                let target = document.pointer(rule.as_str().unwrap().trim_start_matches('#')).expect("a schema");
                check(document, target, value, at)?;
                true
            }
            "allOf" => {
                rule.as_array().unwrap().iter().try_for_each(|s| check(document, s, value, at)).map(|()| true)?
            }
            "anyOf" => rule.as_array().unwrap().iter().any(|s| check(document, s, value, at).is_ok()),
            "type" => match rule {
                Value::Array(types) => types.iter().any(|t| is_of(t, value)),
                one => is_of(one, value),
            },
            "enum" => rule.as_array().unwrap().contains(value),
            "required" => rule.as_array().unwrap().iter().all(|name| value.get(name.as_str().unwrap()).is_some()),
            "items" => {
                let items = value.as_array().into_iter().flatten();
                items.enumerate().try_for_each(|(i, v)| check(document, rule, v, &format!("{at}[{i}]")))?;
                true
            }
            "properties" => {
                for (name, schema) in rule.as_object().unwrap() {
                    if let Some(field) = value.get(name) {
                        check(document, schema, field, &format!("{at}.{name}"))?;
                    }
                }
                true
            }
            "additionalProperties" => {
                let known = schema["properties"].as_object().unwrap();
                let mut others = value.as_object().into_iter().flatten().filter(|(name, _)| !known.contains_key(*name));
                others.all(|(_, v)| rule.is_object() && check(document, rule, v, at).is_ok())
            }
            other => return Err(format!("{at}: keyword {other} is not known here")),
        };
        if !holds {
            return Err(format!("{at}: {keyword} {rule} does not hold for {value}"));
        }
    }
    Ok(())
}

fn is_of(kind: &Value, value: &Value) -> bool {
    match kind.as_str().unwrap() {
        "object" => value.is_object(),
        "array" => value.is_array(),
        "string" => value.is_string(),
        "boolean" => value.is_boolean(),
        "integer" => value.is_u64() || value.is_i64(),
        "number" => value.is_number(),
        "null" => value.is_null(),
        other => panic!("type {other}"),
    }
}

#[test]
fn the_description_and_the_router_have_the_same_paths() {
    let document = description();
    let paths = document["paths"].as_object().unwrap();
    let described: BTreeSet<(String, String)> = paths
        .iter()
        .flat_map(|(path, item)| item.as_object().unwrap().keys().map(|method| (method.clone(), path.clone())))
        .collect();
    let routed: BTreeSet<(String, String)> = routes().table.into_iter().map(|(m, p)| (m.to_owned(), p)).collect();
    assert_eq!(described, routed);
}

#[test]
fn the_checker_finds_what_does_not_fit() {
    let document = description();
    let schema = serde_json::json!({ "$ref": "#/components/schemas/Mark" });
    let fits = |text: &str| check(&document, &schema, &serde_json::from_str(text).unwrap(), "").is_ok();
    assert!(fits(r#"{"tick":3}"#) && !fits(r#"{"tick":"3"}"#) && !fits("{}") && !fits("[]"));
}

/// Sends the request that the path's example needs and checks the answer.
async fn answers_as_described(server: &Running, document: &Value, method: &str, path: &str, url: &str, body: &str) {
    let length = if body.is_empty() && method != "get" { &[("Content-Length", "0")][..] } else { &[] };
    let answer = server.request(&method.to_uppercase(), url, length, body).await;
    let responses = &document["paths"][path][method]["responses"];
    let response = responses.get(answer.status.to_string()).unwrap_or(&responses["default"]);
    let place = format!("{method} {path} -> {}", answer.status);
    for (kind, content) in response.get("content").and_then(Value::as_object).into_iter().flatten() {
        assert!(answer.head.contains(&format!("content-type: {kind}")), "{place}: {}", answer.head);
        if let Some(schema) = content.get("schema") {
            check(document, schema, &answer.json(), &place).unwrap();
        }
    }
    let documented = responses.get(answer.status.to_string()).is_some();
    assert!(documented || answer.status >= 400, "{place} is not described");
    // What the program could not do is a fault of the test.
    assert!(answer.status < 500, "{place}: {}", String::from_utf8_lossy(&answer.body));
}

#[tokio::test(flavor = "multi_thread")]
async fn every_path_answers_as_described() {
    let server = Running::start().await;
    let document = description();
    server.record("one", 12).await;
    let mut steps = vec![
        ("post", "/api/v1/recording/start", r#"{"name":"two"}"#),
        ("post", "/api/v1/recording/mark", r#"{"text":"here"}"#),
        ("get", "/api/v1/status", ""),
        ("get", "/api/v1/sessions", ""),
        ("post", "/api/v1/recording/stop", ""),
        ("post", "/api/v1/recording/stop", ""),
        ("post", "/api/v1/scanner/stop", ""),
        ("post", "/api/v1/login", r#"{"token":"any"}"#),
        ("post", "/api/v1/sessions/{name}/export", r#"{"format":"ply"}"#),
        ("post", "/api/v1/sessions/{name}/compare", r#"{"with":"one"}"#),
    ];
    let paths = document["paths"].as_object().unwrap();
    // The rest as they are, what deletes last.
    for deletes in [false, true] {
        let all =
            paths.iter().flat_map(|(path, item)| item.as_object().unwrap().keys().map(move |m| (m.as_str(), path)));
        for (method, path) in all.filter(|(m, _)| (*m == "delete") == deletes) {
            if !steps.iter().any(|(m, p, _)| *m == method && p == path) {
                steps.push((method, path, if method == "patch" { r#"{"name":"renamed"}"# } else { "" }));
            }
        }
    }
    for (method, path, body) in steps {
        if path.ends_with("/recording/stop") && server.live.status().recording.is_some() {
            server.wait_for_scans(1).await;
        }
        let name = if method == "patch" { "two" } else { "one" };
        let url = path.replace("{name}", if path.contains("reports") { "none" } else { name }).replace("{id}", "1");
        answers_as_described(&server, &document, method, path, &url, body).await;
    }
    server.stop().await.1.unwrap();
}
