"""Maps and surveys in object storage: S3, Google Cloud Storage, Azure and local files, through ``obstore``."""
