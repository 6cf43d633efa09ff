//! The dashboard and the alerts ask only for series that the service has.
//!
//! Every metric name, and every label value that is written out in a query, must appear in the text
//! of `/metrics` right after start: a renamed series or reason would otherwise leave an alert that
//! can never fire.

use placeformer::ops::Metrics;
use std::collections::BTreeSet;
use std::path::Path;

const LABELS: &[&str] = &["reason", "stage", "component", "kind", "result"];

fn read(file: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("docker")
        .join(file);
    std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

fn exposition() -> String {
    let metrics = Metrics::new().expect("every series registers");
    metrics.expect_route("/query", "POST", [200]);
    metrics.render(|_| true).expect("every series renders")
}

/// The expressions of the dashboard (panels and annotations) and of the alert rules, with the file
/// they come from.
fn expressions() -> Vec<(&'static str, String)> {
    let dashboard: serde_json::Value =
        serde_json::from_str(&read("grafana/dashboards/placeformer.json"))
            .expect("the dashboard is JSON");
    let mut found = Vec::new();
    collect(&dashboard, &mut found);
    assert!(
        found.len() > 20,
        "the dashboard has only {} queries",
        found.len()
    );
    let rules = read("prometheus/alerts.yml");
    // Comments, names and annotations hold no metric names but those of the expressions.
    found
        .into_iter()
        .map(|expr| ("dashboard", expr))
        .chain([("alerts", rules)])
        .collect()
}

fn collect(value: &serde_json::Value, into: &mut Vec<String>) {
    match value {
        serde_json::Value::Object(fields) => {
            into.extend(
                fields
                    .get("expr")
                    .and_then(|expr| expr.as_str())
                    .map(str::to_owned),
            );
            fields.values().for_each(|field| collect(field, into));
        }
        serde_json::Value::Array(items) => items.iter().for_each(|item| collect(item, into)),
        _ => {}
    }
}

/// Words of a query that are metric names of the service or of its process.
fn metric_names(query: &str) -> BTreeSet<&str> {
    query
        .split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'))
        .filter(|word| word.starts_with("placeformer_") || word.starts_with("process_"))
        .collect()
}

/// `(label, value)` for each matcher on one of [`LABELS`]; alternatives count one by one.
fn label_values(query: &str) -> Vec<(&'static str, String)> {
    let mut found = Vec::new();
    for label in LABELS {
        for (at, _) in query.match_indices(&format!("{label}=")) {
            let matcher = &query[at + label.len() + 1..];
            let Some(value) = matcher
                .trim_start_matches('~')
                .strip_prefix('"')
                .and_then(|v| v.split('"').next())
            else {
                continue;
            };
            found.extend(value.split('|').map(|one| (*label, one.to_owned())));
        }
    }
    found
}

/// What of `query` is not in `exposed`.
fn missing(query: &str, exposed: &str) -> Vec<String> {
    let known = |name: &str| {
        exposed.lines().any(|line| {
            line.starts_with(&format!("{name}{{")) || line.starts_with(&format!("{name} "))
        })
    };
    let names = metric_names(query)
        .into_iter()
        .filter(|name| !known(name))
        .map(str::to_owned);
    let values = label_values(query)
        .into_iter()
        .map(|(label, value)| format!("{label}=\"{value}\""));
    names
        .chain(values.filter(|matcher| !exposed.contains(matcher)))
        .collect()
}

#[test]
fn dashboard_and_alerts_ask_only_for_series_that_exist() {
    let exposed = exposition();
    for (file, query) in expressions() {
        assert_eq!(
            missing(&query, &exposed),
            Vec::<String>::new(),
            "in the {file}: {query}"
        );
    }
}

#[test]
fn every_series_of_the_service_is_watched_somewhere() {
    let all: String = expressions()
        .into_iter()
        .map(|(_, query)| query + "\n")
        .collect();
    let exposed = exposition();
    let families = exposed
        .lines()
        .filter_map(|line| line.strip_prefix("# TYPE "))
        .filter_map(|line| line.split(' ').next());
    for family in families.filter(|family| family.starts_with("placeformer_")) {
        assert!(
            all.contains(family),
            "{family} is on no dashboard and in no alert"
        );
    }
}

#[test]
fn a_renamed_series_or_reason_is_noticed() {
    let exposed = exposition();
    assert_eq!(
        missing("rate(placeformer_gone_total[5m])", &exposed),
        ["placeformer_gone_total"]
    );
    assert_eq!(
        missing(
            "placeformer_rejected_total{reason=~\"queue_full|bored\"}",
            &exposed
        ),
        ["reason=\"bored\""]
    );
    assert_eq!(
        missing(
            "placeformer_stage_duration_seconds_bucket{stage=\"rerank\"}",
            &exposed
        ),
        Vec::<String>::new()
    );
}

/// The services of a Compose file: each name with the lines below it.
fn services(file: &str) -> Vec<(String, String)> {
    let text = read(file);
    let mut services: Vec<(String, String)> = Vec::new();
    let mut section = "";
    for line in text
        .lines()
        .filter(|line| !line.trim_start().starts_with('#'))
    {
        let indent = line.len() - line.trim_start().len();
        match indent {
            0 if !line.is_empty() => section = line,
            2 if section == "services:" => {
                let name = line.trim().trim_end_matches(':').to_owned();
                services.push((name, String::new()));
            }
            _ if section == "services:" => {
                if let Some((_, lines)) = services.last_mut() {
                    lines.push_str(line);
                    lines.push('\n');
                }
            }
            _ => {}
        }
    }
    services
}

#[test]
fn compose_asks_for_the_password_of_grafana_and_limits_every_service() {
    let files = [
        "compose.yaml",
        "compose.grafana.yaml",
        "compose.replicas.yaml",
    ];
    let mut images = 0;
    for file in files {
        for (name, lines) in services(file) {
            let is_addition = name == "placeformer" && file != "compose.yaml";
            let has = |text: &str| lines.contains(text) || lines.contains("<<: *replica");
            for limit in ["cpus:", "mem_limit:", "pids_limit:"] {
                assert!(is_addition || has(limit), "{file}: {name} has no {limit}");
            }
            let Some(image) = lines
                .lines()
                .find_map(|line| line.trim().strip_prefix("image: "))
            else {
                continue;
            };
            images += 1;
            // ${VARIABLE:-name:version}: an exact version has three numbers.
            let version = image.rsplit(':').next().unwrap().trim_end_matches('}');
            let numbers = version.trim_start_matches('v').split('.').count();
            assert!(
                version == "local" || numbers == 3,
                "{file}: {image} is no exact version"
            );
        }
    }
    assert_eq!(images, 4, "placeformer, prometheus, grafana and haproxy");
    let grafana = read("compose.grafana.yaml");
    assert!(grafana.contains("GF_SECURITY_ADMIN_PASSWORD: ${GRAFANA_PASSWORD:?"));
    let replica = read("compose.replicas.yaml");
    let anchor = replica.split("services:").next().unwrap();
    for limit in ["cpus:", "mem_limit:", "pids_limit:"] {
        assert!(anchor.contains(limit), "a replica has no {limit}");
    }
}
