{{- define "streetfix.name" -}}
{{- printf "%s-%s" .Release.Name .Chart.Name | trunc 63 | trimSuffix "-" -}}
{{- end -}}

{{- define "streetfix.selector" -}}
app.kubernetes.io/name: {{ .Chart.Name }}
app.kubernetes.io/instance: {{ .Release.Name }}
{{- end -}}

{{- define "streetfix.labels" -}}
{{ include "streetfix.selector" . }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
{{- end -}}

{{- define "streetfix.serviceAccount" -}}
{{- if .Values.serviceAccount.create -}}
{{- .Values.serviceAccount.name | default (include "streetfix.name" .) -}}
{{- else -}}
{{- .Values.serviceAccount.name | default "default" -}}
{{- end -}}
{{- end -}}

{{/* Checksum of the named secrets, if Helm can read the cluster. `helm template` cannot. */}}
{{- define "streetfix.secrets" -}}
{{- $namespace := .Release.Namespace -}}
{{- range list .Values.keys.secret .Values.tls.secret .Values.tls.clientCa -}}
{{- if . -}}
{{- with (lookup "v1" "Secret" $namespace .) -}}{{ .data | toJson }}{{- end -}}
{{- end -}}
{{- end -}}
{{- end -}}
