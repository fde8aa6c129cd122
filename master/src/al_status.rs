//! AL status codes with their texts (ETG.1000.6, ETG.1020).
