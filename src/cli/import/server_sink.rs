//! An import through a running server: raw image bodies, sent again while the server is busy, and
//! never again where the request itself is wrong.

use super::sink::{Outcome, Sent, Sink, Stored, Upload};
use crate::cli::client::{BYTES, ClientError, Connection, ServerArgs, ServerClient};
use anyhow::Context;
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{
    Altitude, ContentHash, GeoPoint, Heading, MapName, ReferenceId, Timestamp,
};
use placeformer_store::ReferencePatch;
use reqwest::header::CONTENT_TYPE;
use reqwest::{Method, RequestBuilder, StatusCode};
use serde::Deserialize;
use serde_json::{Map, Value};
use std::collections::HashMap;

/// References listed by one request.
const PAGE: &str = "1000";

/// A server as a sink.
pub(super) struct ServerSink {
    client: ServerClient,
    treatment: PhotoTreatment,
}

/// How the server is told to treat photos, where not as usual.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct PhotoTreatment {
    /// It leaves alone what the photos say about themselves.
    pub(super) ignores_exif: bool,
    /// It stores photos that show nothing by which a place could be known.
    pub(super) allows_uninformative: bool,
}

/// One page of a map's references; of each reference what an import compares.
#[derive(Deserialize)]
struct ReferencePage {
    references: Vec<ListedReference>,
    /// Where the next page begins, if there is one.
    next: Option<String>,
}

#[derive(Deserialize)]
struct ListedReference {
    id: ReferenceId,
    external_id: Option<String>,
    content_sha256: String,
    location: Option<ListedLocation>,
    captured_at: Option<Timestamp>,
}

#[derive(Default, Deserialize)]
struct ListedLocation {
    lat: Option<f64>,
    lon: Option<f64>,
    alt: Option<f64>,
    heading: Option<f64>,
}

impl ListedReference {
    /// `None` if a value is none that a server sends.
    fn stored(self) -> Option<Stored> {
        let mut content = [0; 32];
        hex::decode_to_slice(&self.content_sha256, &mut content).ok()?;
        let ListedLocation {
            lat,
            lon,
            alt,
            heading,
        } = self.location.unwrap_or_default();
        let location = lat.zip(lon).map(|(lat, lon)| GeoPoint::new(lat, lon));
        Some(Stored {
            id: self.id,
            content: ContentHash(content),
            location: location.transpose().ok()?,
            alt: alt.map(Altitude::new).transpose().ok()?,
            heading: heading.map(Heading::new).transpose().ok()?,
            captured_at: self.captured_at,
        })
    }
}

impl ServerSink {
    /// Prepares to send every photo up to `attempts` times.
    pub(super) fn new(
        server: ServerArgs,
        attempts: u32,
        treatment: PhotoTreatment,
    ) -> anyhow::Result<Self> {
        let client = ServerClient::with_attempts(server, attempts)?;
        Ok(Self { client, treatment })
    }

    /// The page that begins at `cursor`; `None` if there is no such map.
    fn page(&self, map: &MapName, cursor: Option<&str>) -> anyhow::Result<Option<ReferencePage>> {
        let request = |connection: &Connection| {
            connection
                .request(Method::GET, "/references")
                .query(&[("map", map.as_str()), ("limit", PAGE)])
                .query(&cursor.map(|cursor| [("cursor", cursor)]))
        };
        match self.client.attempt(request).answer {
            Ok(answer) => {
                let page = serde_json::from_value(answer.json())
                    .context("the server's answer is not a page of references")?;
                Ok(Some(page))
            }
            Err(error) if error.code() == ErrorCode::MapNotFound.as_str() => Ok(None),
            Err(error) => Err(error.into()),
        }
    }
}

impl Sink for ServerSink {
    fn present(&self, map: &MapName) -> anyhow::Result<HashMap<String, Stored>> {
        let mut present = HashMap::new();
        let mut cursor: Option<String> = None;
        while let Some(page) = self.page(map, cursor.as_deref())? {
            for mut reference in page.references {
                let Some(external_id) = reference.external_id.take() else {
                    continue;
                };
                let stored = reference.stored();
                let stored = stored.context("the server lists a reference with wrong values")?;
                present.insert(external_id, stored);
            }
            cursor = page.next;
            if cursor.is_none() {
                break;
            }
        }
        Ok(present)
    }

    fn send(&self, upload: Upload) -> Sent {
        let mut parameters = parameters(&upload);
        if self.treatment.ignores_exif {
            parameters.push(("exif", "false".to_owned()));
        }
        if self.treatment.allows_uninformative {
            parameters.push(("allow_uninformative", "true".to_owned()));
        }
        let request = |connection: &Connection| -> RequestBuilder {
            connection
                .request(Method::POST, "/references")
                .query(&parameters)
                .header(CONTENT_TYPE, BYTES)
                // The clone shares the bytes.
                .body(upload.image.clone())
        };
        let attempted = self.client.attempt(request);
        let outcome = match attempted.answer {
            Ok(answer) => stored(answer.status(), answer.json()),
            Err(error) => refused(&error),
        };
        Sent {
            outcome,
            attempts: attempted.attempts,
        }
    }

    fn update(&self, id: ReferenceId, patch: ReferencePatch) -> Sent {
        let path = format!("/references/{id}");
        let body = change(&patch);
        let request =
            |connection: &Connection| connection.request(Method::PATCH, &path).json(&body);
        let attempted = self.client.attempt(request);
        let outcome = match attempted.answer {
            Ok(_) => Outcome::Updated,
            Err(error) => refused(&error),
        };
        Sent {
            outcome,
            attempts: attempted.attempts,
        }
    }
}

/// The change as the body of `PATCH /references/{id}`.
fn change(patch: &ReferencePatch) -> Value {
    let mut body = Map::new();
    if let Some(Some(location)) = patch.location {
        body.insert("lat".into(), location.lat().into());
        body.insert("lon".into(), location.lon().into());
    }
    if let Some(Some(alt)) = patch.alt {
        body.insert("alt".into(), alt.metres().into());
    }
    if let Some(Some(heading)) = patch.heading {
        body.insert("heading".into(), heading.degrees().into());
    }
    let captured_at = patch.captured_at.flatten();
    if let Some(time) = captured_at {
        body.insert("captured_at".into(), time.to_string().into());
    }
    body.into()
}

fn stored(status: StatusCode, answer: Value) -> Outcome {
    let id = answer["id"].as_str().map(str::to_owned);
    if let Some(id) = id.filter(|_| status == StatusCode::CREATED) {
        return Outcome::Created(id);
    }
    let reference: Option<ListedReference> = serde_json::from_value(answer).ok();
    match reference.and_then(ListedReference::stored) {
        Some(stored) => Outcome::Present(stored),
        None => Outcome::Refused {
            code: "unexpected_answer".into(),
            detail: format!("the server answered {status} without a reference"),
        },
    }
}

fn refused(error: &ClientError) -> Outcome {
    Outcome::Refused {
        code: error.code().to_owned(),
        detail: error.detail(),
    }
}

/// The fields of a photo as query parameters.
fn parameters(upload: &Upload) -> Vec<(&'static str, String)> {
    let fields = &upload.fields;
    let mut parameters = vec![("map", upload.map.to_string())];
    if let Some(id) = &fields.external_id {
        parameters.push(("external_id", id.to_string()));
    }
    if let Some(location) = fields.location {
        parameters.push(("lat", location.lat().to_string()));
        parameters.push(("lon", location.lon().to_string()));
    }
    if let Some(alt) = fields.alt {
        parameters.push(("alt", alt.metres().to_string()));
    }
    if let Some(heading) = fields.heading {
        parameters.push(("heading", heading.degrees().to_string()));
    }
    if let Some(time) = fields.captured_at {
        parameters.push(("captured_at", time.to_string()));
    }
    parameters
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::client::TrustArgs;
    use placeformer_core::types::{GeoPoint, ReferenceFields};
    use std::io::{BufRead, BufReader, Read, Write};
    use std::net::{TcpListener, TcpStream};
    use std::sync::mpsc;

    /// Answers one connection after the other with the given responses and passes on the request
    /// lines.
    fn server(answers: Vec<&'static str>) -> (String, mpsc::Receiver<String>) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}/", listener.local_addr().unwrap());
        let (sender, receiver) = mpsc::sync_channel(64);
        std::thread::spawn(move || {
            for answer in answers {
                let (mut stream, _) = listener.accept().unwrap();
                let _ = sender.send(read_request(&stream));
                let (head, body) = answer.split_once('|').unwrap();
                let length = body.len();
                write!(
                    stream,
                    "HTTP/1.1 {head}\r\ncontent-length: {length}\r\nconnection: close\r\n\r\n{body}"
                )
                .unwrap();
            }
        });
        (url, receiver)
    }

    /// Reads one request to its end and returns its first line.
    fn read_request(stream: &TcpStream) -> String {
        let mut reader = BufReader::new(stream.try_clone().unwrap());
        let mut request = String::new();
        reader.read_line(&mut request).unwrap();
        let mut length = 0;
        let mut line = String::new();
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
        let mut body = Vec::new();
        reader.take(length).read_to_end(&mut body).unwrap();
        request.trim().to_owned()
    }

    fn sink(server: String, attempts: u32) -> ServerSink {
        let _ = rustls::crypto::ring::default_provider().install_default();
        let args = ServerArgs {
            server,
            api_key: None,
            trust: TrustArgs::default(),
            timeout: 10,
        };
        ServerSink::new(args, attempts, PhotoTreatment::default()).unwrap()
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

    const ID: &str = "0197f3c2-7c1e-7d3a-9b1f-2f6f0c1d2e3f";

    #[test]
    fn pages_are_followed_to_the_end_and_an_unknown_map_is_empty() {
        let reference = |external_id: &str, digit: &str, more: &str| {
            let content = digit.repeat(64);
            format!(
                "{{\"id\":\"{ID}\",\"external_id\":{external_id},\
                 \"content_sha256\":\"{content}\"{more}}}"
            )
        };
        let location = ",\"location\":{\"lat\":1.5,\"lon\":-2.25,\"heading\":null},\
                        \"captured_at\":\"2026-05-17T09:30:00Z\"";
        let a = reference("\"a\"", "1", location);
        let nameless = reference("null", "3", "");
        let b = reference("\"b\"", "2", ",\"location\":null,\"captured_at\":null");
        let first = format!("200 OK|{{\"references\":[{a},{nameless}],\"next\":\"n1\"}}");
        let last = format!("200 OK|{{\"references\":[{b}],\"next\":null}}");
        let (url, requests) = server(vec![
            &*first.leak(),
            &*last.leak(),
            "404 No|{\"code\":\"map_not_found\",\"retryable\":false}",
            "200 OK|{\"references\":[{\"id\":\"x\"}],\"next\":null}",
        ]);
        let sink = sink(url, 2);
        let map: MapName = "m".parse().unwrap();
        let present = sink.present(&map).unwrap();
        assert_eq!(present.len(), 2);
        assert_eq!(present["a"].content.to_string(), "1".repeat(64));
        assert_eq!(present["a"].location, GeoPoint::new(1.5, -2.25).ok());
        assert_eq!(
            present["a"].captured_at.unwrap().unix_micros() / 1_000_000,
            1_779_010_200
        );
        assert_eq!((present["b"].location, present["b"].heading), (None, None));
        assert!(requests.iter().nth(1).unwrap().contains("cursor=n1"));
        assert!(sink.present(&map).unwrap().is_empty());
        assert!(sink.present(&map).is_err());
    }

    #[test]
    fn a_change_names_what_it_sets_and_nothing_else() {
        let (url, requests) = server(vec![
            "503 Busy\r\nretry-after: 0|{\"code\":\"overloaded\",\"retryable\":true}",
            "200 OK|{}",
            "404 No|{\"code\":\"reference_not_found\",\"retryable\":false}",
        ]);
        let sink = sink(url, 3);
        let patch = ReferencePatch {
            location: Some(GeoPoint::new(1.5, -2.25).ok()),
            ..ReferencePatch::default()
        };
        assert_eq!(
            change(&patch),
            serde_json::json!({"lat": 1.5, "lon": -2.25})
        );
        let id: ReferenceId = ID.parse().unwrap();
        let sent = sink.update(id, patch);
        assert_eq!((sent.outcome, sent.attempts), (Outcome::Updated, 2));
        let gone = sink.update(id, ReferencePatch::default());
        assert!(matches!(gone.outcome, Outcome::Refused { .. }), "{gone:?}");
        let request = requests.recv().unwrap();
        assert!(
            request.starts_with(&format!("PATCH /references/{ID} ")),
            "{request}"
        );
    }
}
