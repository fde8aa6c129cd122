//! Objects of the devices over CoE.

use super::*;

impl Client {
    fn data_type(&self, device: &str, index: u16, sub: u8) -> Option<DataType> {
        let device = state::device_named(&self.hub.machine, device)?;
        let dictionary = &self.hub.machine.devices.get(device)?.selection.dictionary;
        let item = dictionary.item(index, sub)?;
        DataType::named(&item.type_name, item.bit_len)
    }

    pub(super) async fn sdo_read(
        &self,
        device: &str,
        index: &Index,
        sub: u8,
        complete: bool,
    ) -> Result<Map<String, Value>, OpError> {
        let number = index.number()?;
        let mailbox = self.hub.mailboxes()?.device(device).map_err(refused)?;
        let data_type = self.data_type(device, number, sub).filter(|_| !complete);
        let transfer = async move {
            let read = match complete {
                true => mailbox.upload_complete(number, sub).await,
                false => mailbox.upload(number, sub).await,
            };
            let bytes = read.map_err(refused)?;
            let mut answer = object(json!({"data": hex(&bytes)}));
            if let Some(data_type) = data_type {
                answer.insert("value".to_owned(), value(data_type, &bytes));
            }
            Ok(answer)
        };
        self.transfer(None, transfer).await
    }

    async fn transfer(
        &self,
        owner: Option<&Claim>,
        transfer: impl Future<Output = Outcome> + Send + 'static,
    ) -> Outcome {
        let work = Work::Transfer(Transfer(Box::pin(transfer)));
        let mut answer = self.submit(owner, vec![work], true).await?;
        answer.remove("request");
        Ok(answer)
    }

    /// Returns the bytes of `data`, or of `value` in the type of the dictionary.
    pub(super) fn sdo_bytes(
        &self,
        device: &str,
        index: &Index,
        sub: u8,
        data: Option<String>,
        value: Option<Value>,
    ) -> Result<Vec<u8>, OpError> {
        let number = index.number()?;
        let bad = |message: String| OpError::new(ErrorCode::BadRequest, message);
        match (data, value) {
            (Some(data), None) => {
                unhex(&data).ok_or_else(|| bad("`data` is not hex, such as \"0100\"".to_owned()))
            }
            (None, Some(value)) => {
                let Some(data_type) = self.data_type(device, number, sub) else {
                    let object = address(number, sub);
                    return Err(bad(format!("the type of {object} is not known"))
                        .help("give the bytes as `data`"));
                };
                let text = match &value {
                    Value::String(text) => text.clone(),
                    Value::Bool(on) => u8::from(*on).to_string(),
                    other => other.to_string(),
                };
                data_type
                    .read(&text)
                    .map_err(|error| bad(format!("`value`: {error}")))
            }
            _ => Err(bad("`sdo_write` needs either `data` or `value`".to_owned())),
        }
    }

    pub(super) async fn sdo_write(
        &self,
        claim: &Claim,
        device: &str,
        index: &Index,
        sub: u8,
        complete: bool,
        bytes: &[u8],
    ) -> Result<Map<String, Value>, OpError> {
        if complete {
            let message = "complete access is for reading only";
            return Err(OpError::new(ErrorCode::BadRequest, message)
                .help("write the subindices one by one"));
        }
        let number = index.number()?;
        let mailbox = self.hub.mailboxes()?.device(device).map_err(refused)?;
        let bytes = bytes.to_vec();
        let transfer = async move {
            let written = mailbox.download(number, sub, &bytes).await;
            written.map(|()| Map::new()).map_err(refused)
        };
        self.transfer(Some(claim), transfer).await
    }
}

/// Returns the JSON value of an object's bytes.
fn value(data_type: DataType, bytes: &[u8]) -> Value {
    match data_type.kind {
        Kind::Unsigned | Kind::Signed => {
            let integer = data_type.integer(bytes);
            let small = integer.and_then(|integer| i64::try_from(integer).ok());
            small.map_or_else(|| json!(integer.map(|n| n.to_string())), |n| json!(n))
        }
        Kind::Real => json!(data_type.show(bytes).parse::<f64>().ok()),
        _ => json!(data_type.show(bytes)),
    }
}

fn refused(error: MailboxError) -> OpError {
    let message = error.to_string();
    match error {
        MailboxError::Unknown { .. } => OpError::new(ErrorCode::UnknownName, message),
        MailboxError::None { .. } => OpError::new(ErrorCode::Refused, message),
        MailboxError::Closed { .. } => OpError::new(ErrorCode::NotUp, message),
        MailboxError::Sdo { source, .. } => match source.abort_code() {
            Some(code) => OpError::new(ErrorCode::Aborted, message).with("abort_code", code),
            None if source.is_timeout() => OpError::new(ErrorCode::Timeout, message),
            None => OpError::new(ErrorCode::Failed, message),
        },
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn unhex(text: &str) -> Option<Vec<u8>> {
    let digits: Vec<u8> = text.bytes().filter(|byte| *byte != b' ').collect();
    if !digits.len().is_multiple_of(2) || !digits.iter().all(u8::is_ascii_hexdigit) {
        return None;
    }
    let pair = |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok();
    digits.chunks_exact(2).map(pair).collect()
}
