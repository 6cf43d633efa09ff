//! Through a running server: raw image bodies, patient with a busy server, never with a wrong
//! request.

use super::sink::{Outcome, Sent, Sink, UNREACHABLE, Upload};
use anyhow::{Context, bail};
use placeformer_core::types::MapName;
use rand::RngExt;
use reqwest::StatusCode;
use reqwest::blocking::{Client, RequestBuilder, Response};
use reqwest::header::RETRY_AFTER;
use serde_json::Value;
use std::collections::HashMap;
use std::time::Duration;
use time::format_description::well_known::Rfc3339;

/// Where the server is, and how patient to be with it.
pub(super) struct Settings {
    pub(super) url: String,
    pub(super) api_key: Option<String>,
    pub(super) timeout: Duration,
    pub(super) attempts: u32,
}

/// A server as a sink.
pub(super) struct HttpSink {
    client: Client,
    settings: Settings,
}

/// References asked for at once when resuming.
const PAGE: &str = "1000";
/// The first wait; it doubles with every attempt.
const FIRST_WAIT: Duration = Duration::from_millis(200);
/// The longest wait, also where the server asks for a longer one.
const LONGEST_WAIT: Duration = Duration::from_secs(60);

/// One attempt.
enum Attempt {
    Answered(Value, StatusCode),
    Refused {
        code: String,
        detail: String,
    },
    /// Worth trying again, after this long if the server said so.
    Again {
        code: String,
        detail: String,
        after: Option<Duration>,
    },
}

impl HttpSink {
    pub(super) fn new(settings: Settings) -> anyhow::Result<Self> {
        let client = Client::builder().timeout(settings.timeout).build()?;
        Ok(Self { client, settings })
    }

    fn url(&self, path: &str) -> String {
        format!("{}{path}", self.settings.url.trim_end_matches('/'))
    }

    /// Sends until answered, refused for good, or out of attempts.
    fn patiently(&self, request: impl Fn() -> RequestBuilder) -> (Attempt, u32) {
        let mut wait = FIRST_WAIT;
        for attempt in 1.. {
            let outcome = self.once(request());
            match outcome {
                Attempt::Again { after, .. } if attempt < self.settings.attempts => {
                    // Jitter keeps many clients from coming back at once.
                    let own = wait.mul_f64(rand::rng().random_range(0.5..1.5));
                    std::thread::sleep(
                        after
                            .unwrap_or(own)
                            .clamp(own.min(LONGEST_WAIT), LONGEST_WAIT),
                    );
                    wait = (wait * 2).min(LONGEST_WAIT);
                }
                outcome => return (outcome, attempt),
            }
        }
        unreachable!("the loop returns at the last attempt")
    }

    fn once(&self, mut request: RequestBuilder) -> Attempt {
        if let Some(key) = &self.settings.api_key {
            request = request.bearer_auth(key);
        }
        match request.send() {
            Ok(response) => judge(response),
            Err(error) => {
                let detail = format!("{:#}", anyhow::Error::new(error));
                Attempt::Again {
                    code: UNREACHABLE.into(),
                    detail,
                    after: None,
                }
            }
        }
    }
}

fn judge(response: Response) -> Attempt {
    let status = response.status();
    let after = response
        .headers()
        .get(RETRY_AFTER)
        .and_then(|value| value.to_str().ok()?.trim().parse().ok());
    let after = after.map(Duration::from_secs);
    let body = match response.text() {
        Ok(body) => body,
        Err(error) => {
            return Attempt::Again {
                code: UNREACHABLE.into(),
                detail: error.to_string(),
                after,
            };
        }
    };
    let value: Value = serde_json::from_str(&body).unwrap_or_default();
    if status.is_success() {
        return Attempt::Answered(value, status);
    }
    let text = |key: &str| value[key].as_str().map(str::to_owned);
    let code = text("code").unwrap_or_else(|| format!("http_{}", status.as_u16()));
    let detail = text("detail")
        .or_else(|| text("title"))
        .unwrap_or_else(|| format!("the server answered {status}"));
    // A server that is busy or restarting; a proxy in front of it says so without our error
    // document.
    let passing = value["retryable"]
        .as_bool()
        .unwrap_or(matches!(status.as_u16(), 408 | 429 | 500 | 502 | 503 | 504));
    if passing {
        Attempt::Again {
            code,
            detail,
            after,
        }
    } else {
        Attempt::Refused { code, detail }
    }
}

impl Sink for HttpSink {
    fn present(&self, map: &MapName) -> anyhow::Result<HashMap<String, String>> {
        let mut present = HashMap::new();
        let mut cursor: Option<String> = None;
        loop {
            let page = || {
                let request = self
                    .client
                    .get(self.url("/references"))
                    .query(&[("map", map.as_str()), ("limit", PAGE)]);
                request.query(&cursor.as_ref().map(|cursor| [("cursor", cursor)]))
            };
            let value = match self.patiently(page).0 {
                Attempt::Answered(value, _) => value,
                Attempt::Refused { code, .. }
                    if code == placeformer_core::error::ErrorCode::MapNotFound.as_str() =>
                {
                    break;
                }
                Attempt::Refused { code, detail } | Attempt::Again { code, detail, .. } => {
                    bail!("{}: {detail} ({code})", self.settings.url)
                }
            };
            let references = value["references"]
                .as_array()
                .context("the server's answer is not a page of references")?;
            for reference in references {
                if let (Some(id), Some(hash)) = (
                    reference["external_id"].as_str(),
                    reference["content_sha256"].as_str(),
                ) {
                    present.insert(id.to_owned(), hash.to_owned());
                }
            }
            match value["next"].as_str() {
                Some(next) => cursor = Some(next.to_owned()),
                None => break,
            }
        }
        Ok(present)
    }

    fn send(&self, upload: Upload) -> Sent {
        let parameters = parameters(&upload);
        let request = || {
            let request = self.client.post(self.url("/references")).query(&parameters);
            // The server looks at the bytes themselves. Cloning shares them.
            request
                .header("content-type", "application/octet-stream")
                .body(upload.image.clone())
        };
        let (attempt, attempts) = self.patiently(request);
        let outcome = match attempt {
            Attempt::Answered(value, status) => match value["id"].as_str() {
                Some(id) if status == StatusCode::CREATED => Outcome::Created(id.to_owned()),
                Some(id) => Outcome::Present(id.to_owned()),
                None => Outcome::Refused {
                    code: "unexpected_answer".into(),
                    detail: format!("the server answered {status} without a reference id"),
                },
            },
            Attempt::Refused { code, detail } | Attempt::Again { code, detail, .. } => {
                Outcome::Refused { code, detail }
            }
        };
        Sent { outcome, attempts }
    }
}

fn parameters(upload: &Upload) -> Vec<(&'static str, String)> {
    let fields = &upload.fields;
    let mut parameters = vec![("map", upload.map.to_string())];
    parameters.extend(
        fields
            .external_id
            .iter()
            .map(|id| ("external_id", id.to_string())),
    );
    if let Some(location) = fields.location {
        parameters.extend([
            ("lat", location.lat().to_string()),
            ("lon", location.lon().to_string()),
        ]);
    }
    parameters.extend(
        fields
            .heading
            .map(|heading| ("heading", heading.degrees().to_string())),
    );
    let captured_at = fields
        .captured_at
        .and_then(|time| time.format(&Rfc3339).ok());
    parameters.extend(captured_at.map(|time| ("captured_at", time)));
    parameters
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_core::types::{GeoPoint, ReferenceFields};
    use std::io::{BufRead, BufReader, Read, Write};
    use std::net::TcpListener;
    use std::sync::mpsc;

    /// Answers one connection after the other with the given responses and passes on the request
    /// lines.
    fn server(answers: Vec<&'static str>) -> (String, mpsc::Receiver<String>) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}/", listener.local_addr().unwrap());
        let (sender, receiver) = mpsc::sync_channel(64);
        std::thread::spawn(move || {
            for answer in answers {
                let (stream, _) = listener.accept().unwrap();
                let mut reader = BufReader::new(stream.try_clone().unwrap());
                let (mut line, mut length) = (String::new(), 0usize);
                reader.read_line(&mut line).unwrap();
                let request = line.trim().to_owned();
                loop {
                    line.clear();
                    reader.read_line(&mut line).unwrap();
                    let lower = line.to_ascii_lowercase();
                    if let Some(value) = lower.strip_prefix("content-length:") {
                        length = value.trim().parse().unwrap();
                    }
                    if line.trim().is_empty() {
                        break;
                    }
                }
                reader
                    .take(length as u64)
                    .read_to_end(&mut Vec::new())
                    .unwrap();
                let _ = sender.send(request);
                let (head, body) = answer.split_once('|').unwrap();
                let mut stream = stream;
                write!(
                    stream,
                    "HTTP/1.1 {head}\r\ncontent-length: {}\r\nconnection: close\r\n\r\n{body}",
                    body.len()
                )
                .unwrap();
            }
        });
        (url, receiver)
    }

    fn sink(url: String, attempts: u32) -> HttpSink {
        let _ = rustls::crypto::ring::default_provider().install_default();
        HttpSink::new(Settings {
            url,
            api_key: None,
            timeout: Duration::from_secs(10),
            attempts,
        })
        .unwrap()
    }

    fn upload() -> Upload {
        let fields = ReferenceFields {
            external_id: Some("a b&c.jpg".parse().unwrap()),
            location: Some(GeoPoint::new(1.5, -2.25).unwrap()),
            ..Default::default()
        };
        Upload {
            map: "m".parse().unwrap(),
            fields,
            image: bytes::Bytes::from_static(b"image"),
        }
    }

    #[test]
    fn a_busy_server_is_asked_again_and_fields_are_sent() {
        let (url, requests) = server(vec![
            "503 Busy\r\nretry-after: 0|{\"code\":\"overloaded\",\"retryable\":true}",
            "429 Slow\r\nretry-after: 0|{\"code\":\"rate_limited\",\"retryable\":true}",
            "201 Created|{\"id\":\"r1\"}",
        ]);
        let sent = sink(url, 5).send(upload());
        assert_eq!(
            sent,
            Sent {
                outcome: Outcome::Created("r1".into()),
                attempts: 3
            }
        );
        let request = requests.recv().unwrap();
        assert!(
            request
                .starts_with("POST /references?map=m&external_id=a+b%26c.jpg&lat=1.5&lon=-2.25 "),
            "{request}"
        );
    }

    #[test]
    fn a_wrong_image_is_not_sent_twice_and_patience_ends() {
        let (url, _) = server(vec![
            "422 No|{\"code\":\"image_undecodable\",\"detail\":\"truncated\",\"retryable\":false}",
        ]);
        let sent = sink(url, 5).send(upload());
        let refused = |code: &str, detail: &str| Outcome::Refused {
            code: code.into(),
            detail: detail.into(),
        };
        assert_eq!(
            sent,
            Sent {
                outcome: refused("image_undecodable", "truncated"),
                attempts: 1
            }
        );
        let (url, _) = server(vec!["502 Bad|<html>", "502 Bad|<html>"]);
        let sent = sink(url, 2).send(upload());
        assert_eq!(
            sent,
            Sent {
                outcome: refused("http_502", "the server answered 502 Bad Gateway"),
                attempts: 2
            }
        );
    }

    #[test]
    fn pages_are_followed_to_the_end_and_an_unknown_map_is_empty() {
        let (url, requests) = server(vec![
            "200 OK|{\"references\":[{\"external_id\":\"a\",\"content_sha256\":\"1\"},{\"external_id\":null}],\"next\":\"n1\"}",
            "200 OK|{\"references\":[{\"external_id\":\"b\",\"content_sha256\":\"2\"}],\"next\":null}",
            "404 No|{\"code\":\"map_not_found\",\"retryable\":false}",
        ]);
        let sink = sink(url, 2);
        let present = sink.present(&"m".parse().unwrap()).unwrap();
        assert_eq!(
            (present.len(), present["a"].as_str(), present["b"].as_str()),
            (2, "1", "2")
        );
        assert!(requests.iter().nth(1).unwrap().contains("cursor=n1"));
        assert!(sink.present(&"m".parse().unwrap()).unwrap().is_empty());
    }
}
