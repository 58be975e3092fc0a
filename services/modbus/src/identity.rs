//! Who the device says it is: function 17 and function 43, MEI type 14 (V1.1b3 clauses 6.13 and 6.21).

use crate::protocol::identification::{
    INDIVIDUAL_ACCESS, MAX_VALUE, MEI_DEVICE_IDENTIFICATION, RESPONSE_HEAD, code, object,
};
use crate::protocol::pdu::{Exception, MAX_PDU, function};
use serde::{Deserialize, Serialize};

/// Most bytes of the text of function 17: a PDU without function, byte count, id and run indicator.
pub const MAX_SERVER_TEXT: usize = MAX_PDU - 4;

/// The key `identity`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IdentityConfig {
    /// Function 17: first byte of the answer.
    pub server_id: u8,
    /// Function 17: what follows the run indicator.
    pub server_text: String,
    pub vendor_name: String,
    pub product_code: String,
    pub revision: String,
    pub vendor_url: Option<String>,
    pub product_name: Option<String>,
    pub model_name: Option<String>,
    pub user_application_name: Option<String>,
    pub extended: Vec<ExtendedObject>,
}

/// An object of the extended category.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExtendedObject {
    /// 128-255.
    pub id: u8,
    pub value: String,
}

impl Default for IdentityConfig {
    fn default() -> Self {
        let version = env!("CARGO_PKG_VERSION");
        Self {
            server_id: 0xD1,
            server_text: format!("dinrail {version}"),
            vendor_name: "dinrail".to_owned(),
            product_code: "modbus-server".to_owned(),
            revision: version.to_owned(),
            vendor_url: None,
            product_name: None,
            model_name: None,
            user_application_name: None,
            extended: Vec::new(),
        }
    }
}

/// An identity that cannot be told.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum IdentityError {
    #[error("identity.{key} has {got} bytes; at most {max} fit an answer")]
    TooLong { key: &'static str, got: usize, max: usize },
    #[error("identity.extended {entry}: id {id} is not 128 to 255; lower ones belong to the named objects")]
    Id { entry: usize, id: u8 },
    #[error("identity.extended {entry}: id {id} stands there twice")]
    Twice { entry: usize, id: u8 },
}

/// The identity as it is told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    server_id: u8,
    server_text: Vec<u8>,
    /// By id.
    objects: Vec<(u8, Vec<u8>)>,
}

impl Default for Identity {
    fn default() -> Self {
        IdentityConfig::default().build().unwrap_or(Self {
            server_id: 0,
            server_text: vec![],
            objects: vec![],
        })
    }
}

impl IdentityConfig {
    /// Checks lengths and ids.
    pub fn build(&self) -> Result<Identity, IdentityError> {
        let max = MAX_SERVER_TEXT;
        if self.server_text.len() > max {
            return Err(IdentityError::TooLong { key: "server_text", got: self.server_text.len(), max });
        }
        let named: [(u8, &'static str, Option<&String>); 7] = [
            (object::VENDOR_NAME, "vendor_name", Some(&self.vendor_name)),
            (object::PRODUCT_CODE, "product_code", Some(&self.product_code)),
            (object::REVISION, "revision", Some(&self.revision)),
            (object::VENDOR_URL, "vendor_url", self.vendor_url.as_ref()),
            (object::PRODUCT_NAME, "product_name", self.product_name.as_ref()),
            (object::MODEL_NAME, "model_name", self.model_name.as_ref()),
            (object::USER_APPLICATION_NAME, "user_application_name", self.user_application_name.as_ref()),
        ];
        let mut objects = Vec::new();
        for (id, key, value) in named {
            let Some(value) = value else { continue };
            if value.len() > MAX_VALUE {
                return Err(IdentityError::TooLong { key, got: value.len(), max: MAX_VALUE });
            }
            objects.push((id, value.clone().into_bytes()));
        }
        for (i, ExtendedObject { id, value }) in self.extended.iter().enumerate() {
            let (entry, id) = (i + 1, *id);
            if id < object::FIRST_EXTENDED {
                return Err(IdentityError::Id { entry, id });
            }
            if objects.iter().any(|(other, _)| *other == id) {
                return Err(IdentityError::Twice { entry, id });
            }
            if value.len() > MAX_VALUE {
                return Err(IdentityError::TooLong { key: "extended", got: value.len(), max: MAX_VALUE });
            }
            objects.push((id, value.clone().into_bytes()));
        }
        objects.sort_by_key(|(id, _)| *id);
        Ok(Identity {
            server_id: self.server_id,
            server_text: self.server_text.clone().into_bytes(),
            objects,
        })
    }
}

impl Identity {
    /// Writes the answer to function 17.
    pub fn report(&self, running: bool, out: &mut [u8; MAX_PDU]) -> usize {
        let text = self.server_text.get(..MAX_SERVER_TEXT).unwrap_or(&self.server_text);
        let run = if running { 0xFF } else { 0 };
        out[..4].copy_from_slice(&[function::REPORT_SERVER_ID, 2 + text.len() as u8, self.server_id, run]);
        out[4..4 + text.len()].copy_from_slice(text);
        4 + text.len()
    }

    /// Basic, regular or extended, as the objects are.
    fn conformity(&self) -> u8 {
        match self.objects.last() {
            Some((id, _)) if *id >= object::FIRST_EXTENDED => code::EXTENDED,
            Some((id, _)) if *id > object::REVISION => code::REGULAR,
            _ => code::BASIC,
        }
    }

    /// Writes the answer to function 43/14. An unknown first object of a stream begins it anew; of an individual
    /// access it is exception 02 (clause 6.21).
    pub fn read(&self, read_code: u8, first: u8, out: &mut [u8; MAX_PDU]) -> Result<usize, Exception> {
        let last = match read_code {
            code::BASIC => object::REVISION,
            code::REGULAR => object::FIRST_EXTENDED - 1,
            code::EXTENDED => u8::MAX,
            _ => first,
        };
        let known = self.objects.iter().any(|(id, _)| *id == first && *id <= last);
        if read_code == code::INDIVIDUAL && !known {
            return Err(Exception::IllegalDataAddress);
        }
        let first = if known { first } else { 0 };
        let (mut len, mut count, mut next) = (RESPONSE_HEAD, 0, None);
        for (id, value) in self.objects.iter().filter(|(id, _)| (first..=last).contains(id)) {
            let end = len + 2 + value.len();
            let Some(slot) = out.get_mut(len..end) else {
                next = Some(*id);
                break;
            };
            slot[0] = *id;
            slot[1] = value.len() as u8;
            slot[2..].copy_from_slice(value);
            len = end;
            count += 1;
        }
        let more = if next.is_some() { 0xFF } else { 0 };
        out[..RESPONSE_HEAD].copy_from_slice(&[
            function::ENCAPSULATED_INTERFACE,
            MEI_DEVICE_IDENTIFICATION,
            read_code,
            self.conformity() | INDIVIDUAL_ACCESS,
            more,
            next.unwrap_or(0),
            count,
        ]);
        Ok(len)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::protocol::pdu::Request;
    use crate::protocol::{Response, decode_response, identification};

    fn config() -> IdentityConfig {
        IdentityConfig {
            vendor_name: "V".into(),
            product_code: "P".into(),
            revision: "R1".into(),
            ..IdentityConfig::default()
        }
    }

    /// Conformity, more, next, objects.
    type Told = (u8, bool, u8, Vec<(u8, String)>);

    fn read(identity: &Identity, code: u8, object: u8) -> Result<Told, Exception> {
        let mut out = [0; MAX_PDU];
        let len = identity.read(code, object, &mut out)?;
        let request = Request::ReadDeviceIdentification { code, object };
        let Ok(Response::ReadDeviceIdentification { conformity, more, next, objects, .. }) =
            decode_response(&request, &out[..len])
        else {
            panic!("{:02X?}", &out[..len]);
        };
        let objects = identification::objects(objects)
            .map(|(id, value)| (id, String::from_utf8(value.to_vec()).unwrap()))
            .collect();
        Ok((conformity, more, next, objects))
    }

    #[test]
    fn streams_and_single_objects() {
        let identity = IdentityConfig {
            product_name: Some("N".into()),
            extended: vec![ExtendedObject { id: 0x90, value: "X".into() }],
            ..config()
        }
        .build()
        .unwrap();
        let ids = |code, object| {
            let (conformity, more, _, objects) = read(&identity, code, object).unwrap();
            assert_eq!((conformity, more), (0x83, false));
            objects.into_iter().map(|(id, _)| id).collect::<Vec<_>>()
        };
        assert_eq!(ids(1, 0), [0, 1, 2]);
        assert_eq!(ids(1, 1), [1, 2]);
        assert_eq!(ids(1, 0x90), [0, 1, 2], "an object of another category begins anew");
        assert_eq!(ids(2, 0), [0, 1, 2, 4]);
        assert_eq!(ids(2, 3), [0, 1, 2, 4], "an unknown object begins anew");
        assert_eq!(ids(3, 0), [0, 1, 2, 4, 0x90]);
        assert_eq!(ids(4, 4), [4]);
        assert_eq!(read(&identity, 4, 5).unwrap_err(), Exception::IllegalDataAddress);
        assert_eq!(read(&config().build().unwrap(), 3, 0).unwrap().0, 0x81);
    }

    #[test]
    fn what_does_not_fit_follows() {
        let extended =
            (0x80..=0x8F).map(|id| ExtendedObject { id, value: "0123456789".repeat(10) }).collect();
        let identity = IdentityConfig { extended, ..config() }.build().unwrap();
        let (mut object, mut seen, mut answers) = (0, Vec::new(), 0);
        loop {
            let (_, more, next, objects) = read(&identity, 3, object).unwrap();
            seen.extend(objects.iter().map(|(id, _)| *id));
            answers += 1;
            if !more {
                break;
            }
            object = next;
        }
        assert_eq!(seen, [0, 1, 2].into_iter().chain(0x80..=0x8F).collect::<Vec<_>>());
        assert_eq!(answers, 8);
        // The longest value fits alone.
        let long = IdentityConfig { vendor_name: "x".repeat(244), ..config() }.build().unwrap();
        assert!(read(&long, 1, 0).unwrap().1);
    }

    #[test]
    fn function_17() {
        let identity =
            IdentityConfig { server_id: 5, server_text: "abc".into(), ..config() }.build().unwrap();
        let mut out = [0; MAX_PDU];
        assert_eq!(identity.report(true, &mut out), 7);
        assert_eq!(out[..7], [17, 5, 5, 0xFF, b'a', b'b', b'c']);
        identity.report(false, &mut out);
        assert_eq!(out[3], 0);
    }

    #[test]
    fn identities_that_cannot_be_told() {
        let error = |config: IdentityConfig| config.build().unwrap_err().to_string();
        let extended = |id| ExtendedObject { id, value: String::new() };
        insta::assert_snapshot!(error(IdentityConfig { vendor_name: "x".repeat(245), ..config() }), @"identity.vendor_name has 245 bytes; at most 244 fit an answer");
        insta::assert_snapshot!(error(IdentityConfig { server_text: "x".repeat(250), ..config() }), @"identity.server_text has 250 bytes; at most 249 fit an answer");
        insta::assert_snapshot!(error(IdentityConfig { extended: vec![extended(7)], ..config() }), @"identity.extended 1: id 7 is not 128 to 255; lower ones belong to the named objects");
        insta::assert_snapshot!(error(IdentityConfig { extended: vec![extended(200), extended(200)], ..config() }), @"identity.extended 2: id 200 stands there twice");
    }
}
